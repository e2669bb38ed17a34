"""The engine, its worker and the parsers on a system without `resource`, `prctl`, process groups and signals that can be handled."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from gsbake.limited_process import ParserProcess

ROOT = Path(__file__).resolve().parents[2]
BARE = Path(__file__).with_name("bare")
TOY = "from tests.pipeline.toy import main; main()"
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "words.txt").write_text("one two three")
    return folder


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts Python code without what it is about; killed at the end of the test."""
    processes: list[subprocess.Popen[str]] = []

    def run(code: str, *arguments: object) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(BARE), str(ROOT)]), "BARE_LOG": str(tmp_path / "bare.log")}
        processes.append(
            subprocess.Popen(
                [sys.executable, "-c", code, *map(str, arguments)],
                cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
        )
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


def finish(process: subprocess.Popen[str]) -> str:
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    return out


def wait_for(out: Path, pattern: str) -> Path:
    end = time.monotonic() + 30
    while time.monotonic() < end:
        for path in out.glob(pattern):
            return path
        time.sleep(0.02)
    raise AssertionError(f"{pattern} did not appear in {out}")


def test_what_is_taken_away(start: Start) -> None:
    """The other tests would show nothing if it were still there."""
    code = """
import ctypes, os, signal
from gsbake.system import limits, processes
assert limits._resource() is None and not limits.limit_address_space(1 << 30) and limits.peak_memory() > 1 << 20
assert limits.usable_processors() > 0 and not hasattr(os, "killpg") and processes.leads_group(os.getpid())
assert [signal.Signals(number).name for number in processes.stop_signals()] == ["SIGINT", "SIGTERM"]
processes.kill_with_parent()
try:
    ctypes.CDLL(None)
except TypeError:
    print("bare")
"""
    assert finish(start(code)) == "bare\n"


def test_stages_run(tmp_path: Path, photos: Path, start: Start) -> None:
    found = json.loads(finish(start(TOY, tmp_path / "out", photos, "chain", 5, 0.01)))
    assert found["ran"] == ["read", "sum", "tell"]
    assert len((tmp_path / "bare.log").read_text().split()) >= 4  # this process and three workers


def test_a_stage_writes_its_checkpoint_before_it_stops(tmp_path: Path, photos: Path, start: Start) -> None:
    """The worker acknowledges the request, which a signal that only kills could not bring about."""
    code = f"""
import json, os, sys
from pathlib import Path
from gsbake.errors import InterruptedRun
from gsbake.pipeline.supervise import StopSignals, supervise
from gsbake.pipeline.worker import Job
from tests.pipeline.toy import Sum, Toy
folder, kinds, stop = Path({str(tmp_path)!r}), [], StopSignals()
for name in ("out", "checkpoint", "cache"):
    (folder / name).mkdir()
profile = Toy(sum=Sum(steps=500, step_seconds=0.02)).model_dump()
job = Job("tests.pipeline.toy:SUM", str(folder / "out"), {{"read": {str(photos)!r}}}, "tests.pipeline.toy:Toy", profile, 0, 1, "cpu",
          str(folder / "checkpoint"), str(folder / "cache"), str(folder), os.getpid())
def take(message):
    kinds.append(message["kind"])
    stop.count = 1 if message["kind"] == "progress" else stop.count
try:
    supervise(job, folder / "log", stop, take)
except InterruptedRun as error:
    print(json.dumps([str(error), kinds]))
"""
    message, kinds = json.loads(finish(start(code)))
    assert message.startswith("Stopped on request")
    assert kinds[-2:] == ["stopping", "failed"] and "stop sent" in kinds
    assert 1 <= json.loads((tmp_path / "checkpoint" / "state.json").read_text())["step"] < 500


def test_ctrl_c_ends_the_run_and_a_second_one_kills_the_stage(tmp_path: Path, photos: Path, start: Start) -> None:
    process = start(TOY, tmp_path / "out", photos, "stubborn")
    wait_for(tmp_path / "out", "stages/stubborn/*.tmp-*/half.txt")
    workers = psutil.Process(process.pid).children()
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.5)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 75 and "Killed on request" in errors
    assert workers and not psutil.wait_procs(workers, timeout=5)[1]


def test_a_worker_ends_with_a_killed_run(tmp_path: Path, photos: Path, start: Start) -> None:
    """Also one that reports nothing, and so does not find its pipe closed."""
    process = start(TOY, tmp_path / "out", photos, "stubborn")
    wait_for(tmp_path / "out", "stages/stubborn/*.tmp-*/half.txt")
    workers = psutil.Process(process.pid).children()
    process.kill()
    assert workers and not psutil.wait_procs(workers, timeout=5)[1]


def test_a_child_is_killed_with_its_own_children(start: Start) -> None:
    code = """
import subprocess, sys, psutil
from gsbake.python_process import python_command, python_environment
from gsbake.system import processes
nested = "import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(99)']); print(1); time.sleep(99)"
for end in (processes.kill, lambda child: processes.stop_group(child.pid, 5.0)):
    child = processes.start_apart(python_command("-c", nested), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                  stderr=subprocess.DEVNULL, env=python_environment())
    child.stdout.readline()
    tree = processes.process_tree(child.pid)
    end(child)
    print(len(tree), len(psutil.wait_procs(tree, 10)[1]))
"""
    process = start(code)
    out, errors = process.communicate(timeout=60)
    assert out == "2 0\n2 0\n", errors


ASK = """
import json
from gsbake.limited_process import ParserFailedError, ParserProcess
with ParserProcess("tests.system.greedy") as parser:
    found = [parser.ask({"task": "echo", "text": "é\\n"}, 30.0)]
    try:
        found.append(parser.ask({"task": "eat"}, 60.0))
    except ParserFailedError as error:
        found.append(str(error))
    found.append(parser.ask({"task": "echo", "text": "again"}, 30.0))
print(json.dumps(found))
"""


def test_a_parser_that_takes_too_much_memory_is_ended(start: Start) -> None:
    found = json.loads(finish(start(ASK)))
    assert found == [{"echo": "é\n"}, "took more memory than it may", {"echo": "again"}]


def test_the_same_parser_where_the_system_limits_it() -> None:
    with ParserProcess("tests.system.greedy") as parser:
        assert parser.ask({"task": "echo", "text": "é\n"}, 30.0) == {"echo": "é\n"}  # what libraries print is no answer
        assert parser.ask({"task": "eat"}, 60.0) == {"error": "out of memory"}
