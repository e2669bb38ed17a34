"""Batches of small built-in captures on the test cluster, what they computed, and the bytes of plain runs."""

from __future__ import annotations

import hashlib
import json
import os
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
TIMEOUT = 3000.0


def gsbake(*words: object, environment: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
    """A running command of gsbake."""
    return subprocess.Popen(
        [sys.executable, "-m", "gsbake", *map(str, words)], env=dict(environment or os.environ), stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True,
    )  # fmt: skip


def write_captures(folder: Path, count: int, views: int = 12, size: int = 96) -> list[Path]:
    """Built-in captures with different seeds."""
    made = [folder / f"object{seed}" for seed in range(count)]
    for seed, path in enumerate(made):
        process = gsbake("synth", path, "--views", views, "--size", size, "--seed", seed, "--quiet")
        assert process.wait(TIMEOUT) == 0, process.stdout and process.stdout.read()
    return made


def plain_runs(captures: Sequence[Path], root: Path, settings: Sequence[str] = SETTINGS) -> dict[str, dict[str, str]]:
    """{capture: digests} of one plain run after another."""
    for path in captures:
        process = gsbake("run", path, "--out", root / path.name, *_options(settings), "--quiet")
        text, _ = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 0, text[-2000:]
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
    """A running `gsbake batch` with its folder."""

    process: subprocess.Popen[str]
    captures: tuple[Path, ...]
    root: Path

    def finish(self) -> str:
        """Wait for its end; returns its output. Raises AssertionError unless all captures are done."""
        text, _ = self.process.communicate(timeout=TIMEOUT)
        log = self.root / ".batch" / "snakemake.log"
        assert self.process.returncode == 0, f"{text[-2000:]}\n{log.read_text()[-3000:] if log.exists() else ''}"
        return text

    def wait_until(self, what: str, ready: Callable[[], bool]) -> None:
        """Wait for a moment in the batch. Raises AssertionError when it does not come."""
        deadline = time.monotonic() + TIMEOUT
        while not ready():
            assert self.process.poll() is None and time.monotonic() < deadline, f"{what} did not happen: {self.output()[-2000:]}"
            time.sleep(0.2)

    def output(self) -> str:
        """What the command has printed, once it has ended."""
        return self.process.stdout.read() if self.process.poll() is not None and self.process.stdout else ""

    def runs(self, capture: Path, stage: str) -> bool:
        """Whether a stage of a capture has been started and not finished."""
        out = self.root / capture.name
        return stages(out, "stage started").count(stage) > stages(out, "stage finished").count(stage)

    def check(self, expected: Mapping[str, Mapping[str, str]]) -> int:
        """Assert that all captures have the expected bytes and no finished stage was computed again; returns the stages that were lost."""
        lost = 0
        for path in self.captures:
            out = self.root / path.name
            found = digests(out)
            different = sorted(name for name in expected[path.name].keys() | found.keys() if expected[path.name].get(name) != found.get(name))
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
    return Batch(gsbake(*words, environment=environment), tuple(captures), root)
