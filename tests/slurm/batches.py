"""Batches of small built-in captures on the test cluster, what they computed, and the bytes of plain runs."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROFILE = "smoke"
#: Smaller than the profile, so that a fault costs little time; training still writes checkpoints.
SETTINGS = (
    "train.iterations=60", "train.max_size=96", "train.init_surfels=1200", "surfels.max_count=2000", "refine.iterations=20",
    "mesh.max_resolution=64", "mesh.faces=1000", "bake.size=128", "bake.occlusion_rays=4", "report.views=1", "report.view_size=64",
)  # fmt: skip
#: Seconds that one command may take; the tests share their machine with others.
TIMEOUT = 4 * 3600.0


def gsbake(*words: object) -> None:
    """Run a command of gsbake. Raises AssertionError when it fails."""
    command = [sys.executable, "-m", "gsbake", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-2000:]


def write_captures(folder: Path, count: int, views: int = 12, size: int = 96) -> list[Path]:
    """Built-in captures with different seeds."""
    made = [folder / f"object{seed}" for seed in range(count)]
    for seed, path in enumerate(made):
        if not (path / "truth").is_dir():
            gsbake("synth", path, "--views", views, "--size", size, "--seed", seed, "--quiet")
    return made


def plain_runs(captures: Sequence[Path], root: Path, settings: Sequence[str] = SETTINGS) -> dict[str, dict[str, str]]:
    """{capture: digests} of one plain run after another."""
    for path in captures:
        gsbake("run", path, "--out", root / path.name, *_options(settings), "--quiet")
    return {path.name: digests(root / path.name) for path in captures}


def _options(settings: Sequence[str]) -> list[str]:
    return ["--profile", PROFILE, "--threads", "1", *(word for setting in settings for word in ("--set", setting))]


def digests(out: Path) -> dict[str, str]:
    """{file: digest} of all that a run determines: every artifact but the report, which holds run times, and the results."""
    paths = [path for path in out.glob("stages/*/????????????????/**/*") if path.is_file() and path.name != "manifest.json"]
    paths = [path for path in paths if path.relative_to(out).parts[1] != "report"] + [out / "asset.glb", out / "cameras.json"]
    return {path.relative_to(out).as_posix(): hashlib.blake2b(path.read_bytes()).hexdigest() for path in paths}


def events(out: Path) -> list[dict[str, object]]:
    """The events of all runs in an output folder; a line that is just being written is left out."""
    found = []
    with suppress(FileNotFoundError):
        for line in (out / "events.jsonl").read_text(errors="replace").splitlines():
            with suppress(ValueError):
                found.append(json.loads(line))
    return found


def stages(out: Path, event: str) -> list[str]:
    """Stages with an event, in order."""
    return [str(entry["stage"]) for entry in events(out) if entry["event"] == event]


@dataclass(frozen=True)
class Batch:
    """A running `gsbake batch` with its folder; it writes into the file `log`."""

    process: subprocess.Popen[bytes]
    captures: tuple[Path, ...]
    root: Path
    log: Path

    def finish(self) -> str:
        """Wait for its end; returns its output. Raises AssertionError unless all captures are done."""
        self.process.wait(TIMEOUT)
        log = self.root / ".batch" / "snakemake.log"
        assert self.process.returncode == 0, f"{self.output()}\n{log.read_text()[-3000:] if log.exists() else ''}"
        return self.output()

    def wait_until(self, what: str, ready: Callable[[], bool]) -> None:
        """Wait for a moment in the batch. Raises AssertionError when it does not come."""
        deadline = time.monotonic() + TIMEOUT
        while not ready():
            assert self.process.poll() is None and time.monotonic() < deadline, f"{what} did not happen: {self.output()}"
            time.sleep(0.2)

    def output(self) -> str:
        """The end of what the command has printed."""
        return self.log.read_text(errors="replace")[-3000:]

    def runs(self, capture: Path, stage: str) -> bool:
        """Whether a stage of a capture has been started and not finished."""
        out = self.root / capture.name
        return stages(out, "stage started").count(stage) > stages(out, "stage finished").count(stage)

    def check(self, expected: Mapping[str, Mapping[str, str]]) -> int:
        """Assert that all captures have the expected bytes and no finished stage was computed again; returns the stages that were lost."""
        lost = 0
        for path in self.captures:
            out = self.root / path.name
            found, wanted = digests(out), expected[path.name]
            different = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
            assert not different, f"{path.name}: other bytes in {different[:5]}"
            finished = Counter(stages(out, "stage finished"))
            assert all(count == 1 for count in finished.values()), f"{path.name}: computed twice: {finished}"
            lost += len(stages(out, "stage started")) - sum(finished.values())
        return lost


def start_batch(
    captures: Sequence[Path], root: Path, environment: Mapping[str, str], *more: object, settings: Sequence[str] = SETTINGS
) -> Batch:
    """Start a batch with Slurm, one thread a job."""
    words = ("batch", *captures, "--out", root, "--executor", "slurm", *_options(settings), *more)
    root.mkdir(parents=True, exist_ok=True)
    log = root.with_name(f"{root.name}.log")
    with log.open("ab") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "gsbake", *map(str, words)], env=dict(environment), stdin=subprocess.DEVNULL, stdout=sink, stderr=sink,
            start_new_session=True,
        )  # fmt: skip
    return Batch(process, tuple(captures), root, log)
