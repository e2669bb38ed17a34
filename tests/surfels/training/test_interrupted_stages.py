"""The train and refine stages give identical files after interruption by SIGTERM and SIGKILL."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

SETTINGS = (
    "ingest.max_size=96", "stereo.enabled=never", "train.iterations=260", "train.max_size=96", "train.init_surfels=1500",
    "surfels.max_count=2500", "surfels.shading=pbr", "light.size=8", "refine.iterations=120", "skip.pose_refinement=keep",
)  # fmt: skip

#: Runs up to a stage and sends itself a signal after a number of that stage's steps (signal 0: never).
RUNNER = """
import os, sys
from pathlib import Path
from gsbake.api import RunOptions
from gsbake.api import open_session
from gsbake.pipeline.engine import Observer
from gsbake.errors import GsbakeError

out, stage, step, number = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])

class Stopper(Observer):
    sent = number == 0

    def progress(self, name, done, total, text, live):
        if not self.sent and name == stage and done >= step and "surfels" in live:
            self.sent = True  # a second SIGTERM would not wait for the checkpoint
            os.kill(os.getpid(), number)

session = open_session(RunOptions(out=Path(out)), Stopper())
try:
    session.engine.run(stage)
except GsbakeError as error:
    sys.exit(error.exit_code)
"""


def run(out: Path, stage: str, step: int = 0, number: int = 0) -> int:
    """Exit code of one run up to `stage`."""
    command = [sys.executable, "-c", RUNNER, str(out), stage, str(step), str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    print(done.stdout[-3000:], done.stderr[-3000:])
    return done.returncode


def gsbake(*args: object) -> None:
    done = subprocess.run([sys.executable, "-m", "gsbake", *map(str, args)], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def results(out: Path) -> dict[str, bytes]:
    """The files of the stages train and refine."""
    manifests = [path for stage in ("train", "refine") for path in (out / "stages" / stage).glob("*/manifest.json")]
    files = [path for manifest in manifests for path in manifest.parent.iterdir() if path != manifest]
    return {f"{path.parent.parent.name}/{path.name}": path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def posed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An output folder with the inputs of training."""
    root = tmp_path_factory.mktemp("interrupted")
    gsbake("synth", root / "capture", "--views", 10, "--size", 96)
    words = [word for pair in SETTINGS for word in ("--set", pair)]
    gsbake("stereo", root / "capture", "--profile", "smoke", "--out", root / "out", *words)
    return root / "out"


def test_training_that_was_asked_to_stop_gives_identical_files(posed: Path, tmp_path: Path) -> None:
    whole, stopped = shutil.copytree(posed, tmp_path / "whole"), shutil.copytree(posed, tmp_path / "stopped")
    assert run(whole, "train") == 0
    assert run(stopped, "train", 90, signal.SIGTERM) == 75
    assert run(stopped, "train") == 0
    expected = results(whole)
    assert {"train/surfels.safetensors", "train/light.safetensors"} <= expected.keys() and results(stopped) == expected


@pytest.mark.slow
def test_interrupted_stages_give_identical_files(posed: Path, tmp_path: Path) -> None:
    whole, interrupted = tmp_path / "whole", tmp_path / "interrupted"
    shutil.copytree(posed, whole)
    shutil.copytree(posed, interrupted)
    assert run(whole, "refine") == 0
    assert run(interrupted, "train", 90, signal.SIGTERM) == 75
    checkpoints = list((interrupted / "stages" / "train").glob("*.checkpoint/checkpoint.*"))
    assert len(checkpoints) == 1 and checkpoints[0].stat().st_size > 0
    assert run(interrupted, "train", 170, signal.SIGKILL) == -signal.SIGKILL
    assert run(interrupted, "refine", 60, signal.SIGTERM) == 75
    flip_a_byte(next((interrupted / "stages" / "refine").glob("*.checkpoint/checkpoint.*")))  # refining starts over
    assert run(interrupted, "refine", 100, signal.SIGKILL) == -signal.SIGKILL
    assert run(interrupted, "refine") == 0
    expected = results(whole)
    assert {"train/surfels.safetensors", "train/light.safetensors", "refine/surfels.safetensors", "refine/log.csv"} <= expected.keys()
    assert results(interrupted) == expected
