"""Names of captures with everything that a file's name may hold.

Each format, run or parsed as its scheduler does, gives exactly the command of the job, or refuses it in one sentence.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import gsbake.api
from gsbake.batch import coordinator, slurm
from gsbake.batch.captures import BatchOptions
from gsbake.batch.coordinator import run_batch
from gsbake.batch.emit import as_openjd, emit
from gsbake.batch.jobs import Job
from gsbake.batch.slurm import SlurmOptions
from gsbake.errors import UsageError
from gsbake.python_process import python_command, python_environment
from tests.cli import toy_bake
from tests.cli.conftest import Run

Make = Callable[..., Path]

NAMES = {
    "line break": "first\ntouch owned",
    "carriage return": "a\rb",
    "single quote": "it's",
    "double quote": 'say "hello"',
    "comment": "a #b",
    "mapping": "key: value",
    "option": "-rf",
    "long option": "--out=elsewhere",
    "spaces": "  two  spaces ",
    "braces": "{a} {{b}} {",
    "substitution": "$(touch owned)$HOME",
    "backtick": "`touch owned`",
    "percent": "100%j %s",
    "no text": os.fsdecode(b"caf\xe9"),
    "backslash": "a\\nb\\",
    "glob": "*?[a]~;&|<>",
    "separator": "a\u2028b",
}
#: Names that a format cannot hold.
REFUSED = {
    "opencue": {"line break", "carriage return", "no text", "separator"},
    "openjd": {"line break", "carriage return", "no text", "braces"},
}


@pytest.fixture(params=NAMES, ids=NAMES)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def jobs_of(name: str) -> list[Job]:
    """Two jobs of a capture of this name, with a profile and a setting of the same."""
    out = f"/out/{name}"
    made: list[Job] = []
    for stage in ("mesh", "report"):
        command = ("gsbake", stage, f"/photos/{name}", "--out", out, "--profile", f"/{name}.toml", "--set", f"a.b={name}", "--quiet")
        needs = tuple(job.id for job in made)
        made.append(Job(f"c0000_x_{stage}", name, f"/photos/{name}", out, (stage,), command, needs, 1, 100, 1.0, 10))
    return made


@pytest.fixture
def calls(tmp_path: Path) -> Callable[[Sequence[str]], list[tuple[str, ...]]]:
    """Run a command with a `gsbake` on the PATH that notes its arguments; returns the words of each call."""
    tool, log, work = tmp_path / "bin" / "gsbake", tmp_path / "calls", tmp_path / "work"
    tool.parent.mkdir()
    work.mkdir()
    tool.write_text(f"#!/bin/sh\nprintf '%s\\0' gsbake \"$@\" >> {log}\nprintf '\\0' >> {log}\n")
    tool.chmod(0o755)

    def run(command: Sequence[str]) -> list[tuple[str, ...]]:
        environment = python_environment({"PATH": f"{tool.parent}:{os.environ['PATH']}"})
        done = subprocess.run(command, cwd=work, env=environment, capture_output=True, check=False, timeout=120)
        assert done.returncode == 0, done
        assert not [path.name for path in work.rglob("owned*")]
        found = os.fsdecode(log.read_bytes()).split("\0\0")[:-1] if log.exists() else []
        return [tuple(text.split("\0")) for text in found]

    return run


def text_of(form: str, kind: str) -> str | None:
    """The jobs in a format; None where it refuses the name, as it must."""
    if kind in REFUSED.get(form, ()):
        with pytest.raises(UsageError, match="rename it") as error:
            emit(form, jobs_of(NAMES[kind]))
        assert str(error.value).isprintable()
        return None
    return emit(form, jobs_of(NAMES[kind]))


Calls = Callable[[Sequence[str]], list[tuple[str, ...]]]


def test_sh(kind: str, calls: Calls) -> None:
    jobs = jobs_of(NAMES[kind])
    assert calls(["sh", "-c", text_of("sh", kind) or ""]) == [job.command for job in jobs]


def test_slurm(kind: str, calls: Calls, tmp_path: Path) -> None:
    """`sbatch` runs what is wrapped with the shell, as Slurm does."""
    sbatch = tmp_path / "bin" / "sbatch"
    sbatch.write_text('#!/bin/sh\nfor word in "$@"; do case "$word" in --wrap=*) sh -c "${word#--wrap=}";; esac; done\necho 7\n')
    sbatch.chmod(0o755)
    jobs = jobs_of(NAMES[kind])
    assert calls(["sh", "-c", text_of("slurm", kind) or ""]) == [job.command for job in jobs]


def test_opencue(kind: str, calls: Calls) -> None:
    text = text_of("opencue", kind)
    if text is not None:
        (line,) = text.splitlines()
        assert calls(["sh", "-c", line]) == [job.command for job in jobs_of(NAMES[kind])]


def test_json(kind: str) -> None:
    text = text_of("json", kind) or ""
    assert text.isascii() and [tuple(job["command"]) for job in json.loads(text)["jobs"]] == [job.command for job in jobs_of(NAMES[kind])]


@pytest.mark.parametrize("many", [False, True])
def test_openjd(kind: str, many: bool) -> None:
    model = pytest.importorskip("openjd.model")
    jobs = jobs_of(NAMES[kind])
    if many:
        jobs += [Job(**{**jobs[1].document(), "id": f"c{n:04d}_y", "capture": f"y{n}", "needs": ()}) for n in range(1, 100)]
    if kind in REFUSED["openjd"]:
        with pytest.raises(UsageError, match="rename it"):
            as_openjd(jobs)
        return
    template = model.decode_job_template(template=json.loads(as_openjd(jobs)))
    if not many:
        found = [(step.script.actions.onRun.command, *step.script.actions.onRun.args) for step in template.steps]
        assert [tuple(map(str, words)) for words in found] == [job.command for job in jobs]


def test_snakemake(calls: Calls, tmp_path: Path) -> None:
    """All names in one Snakefile, because Snakemake takes seconds to start."""
    pytest.importorskip("snakemake")
    jobs = [Job(**{**jobs_of(name)[0].document(), "id": f"c{number}"}) for number, name in enumerate(NAMES.values())]
    jobs[1] = Job(**{**jobs[1].document(), "needs": ("c0",)})
    (tmp_path / "Snakefile").write_bytes(os.fsencode(emit("snakemake", jobs)))
    found = calls(python_command("-m", "snakemake", "--snakefile", str(tmp_path / "Snakefile"), "--cores", "1", "--scheduler", "greedy"))
    assert sorted(found) == sorted(job.command for job in jobs) and found.index(jobs[0].command) < found.index(jobs[1].command)


#: Everything at once, for what takes longer.
ALL_IN_ONE = os.fsdecode(b"-a #b: {c} {{d}} 'e' \"f\" $(touch owned) `touch owned` 100%j\n\xe9")


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.REGISTRY)


@pytest.mark.slow
@pytest.mark.usefixtures("toy")
@pytest.mark.parametrize("name", [ALL_IN_ONE, NAMES["comment"], NAMES["mapping"]], ids=["all in one", "comment", "mapping"])
def test_a_batch_in_a_folder_of_any_name(make_capture: Make, tmp_path: Path, name: str) -> None:
    pytest.importorskip("snakemake")
    root = tmp_path / name
    (outcome,) = run_batch([make_capture(name)], BatchOptions(root, "smoke", threads=1))
    assert (outcome.state, outcome.message) == ("done", "") and (root / outcome.plan.name / "asset.glb").is_file()
    assert not list(tmp_path.rglob("owned"))


def test_captures_whose_names_begin_with_a_dash(run: Run, make_capture: Make, tmp_path: Path) -> None:
    """Paths in commands are absolute, so that none is taken for an option."""
    make_capture("-n")
    os.chdir(tmp_path / "captures")
    command = run("plan", "--out", "-o", "--profile", "smoke", "--emit", "json", "--", "-n").json["jobs"][0]["command"]
    assert command[2] == str(tmp_path / "captures" / "-n") and command[4] == str(tmp_path / "captures" / "-o" / "-n")


def test_the_command_prints_the_bytes_of_names(make_capture: Make, tmp_path: Path) -> None:
    """Not escapes in their place, which would be other names."""
    capture = make_capture(NAMES["no text"])
    command = python_command("-m", "gsbake", "plan", str(capture), "--out", str(tmp_path / "out"), "--profile", "smoke", "--emit", "sh")
    done = subprocess.run(command, env=python_environment(), capture_output=True, check=False, timeout=60)
    assert os.fsencode(capture) in done.stdout


def test_a_folder_that_slurm_cannot_use(make_capture: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coordinator, "require_snakemake", lambda executor: None)
    with pytest.raises(UsageError, match="'%'"):
        run_batch([make_capture("one")], BatchOptions(tmp_path / "100%j", "smoke"), "slurm")


def test_nodes_in_a_record_of_somebody_else() -> None:
    assert slurm.submit_options(3, ["n1", "n2 --uid=0", "$(touch owned)", 7, "n3"], 4) == "--nice=3 --exclude=n1,n3"
    assert slurm.submit_options(3, ["n1"], 1) == slurm.submit_options(3, "n1", 4) == slurm.submit_options(3, None, 4) == "--nice=3"


@pytest.mark.parametrize("name", ["a b", "x;touch owned", "$(id)", "-p", "", "a\nb", "é"])
def test_names_that_slurm_has_not(name: str) -> None:
    for options in (SlurmOptions(partition=name), SlurmOptions(account=name)):
        with pytest.raises(UsageError, match="takes a name of Slurm"):
            slurm.ask_cluster(options)
