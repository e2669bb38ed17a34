"""The smallest relight bake, run as users run it, and its outcome after a fault: the same bytes, or one documented sentence."""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

SETTINGS = (
    "stereo.enabled=always", "train.iterations=40", "train.max_size=96", "train.init_surfels=1200", "surfels.max_count=2000",
    "refine.iterations=10", "mesh.max_resolution=64", "mesh.faces=1000", "bake.size=128", "bake.fit_size=64", "bake.fit_iterations=10",
    "bake.occlusion_rays=4", "report.views=1", "report.view_size=64",
)  # fmt: skip
#: Exit codes that a refusal may have: wrong usage, bad input, interrupted.
DOCUMENTED = (2, 42, 75)
STAGES = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export")
TIMEOUT = 900


@dataclass(frozen=True)
class End:
    """How a command ended."""

    code: int
    text: str

    @property
    def refused(self) -> bool:
        """Whether it ended with a documented exit code and without a traceback."""
        return self.code in DOCUMENTED and "Traceback" not in self.text and "Internal error" not in self.text


def command(capture: Path | None, out: Path) -> list[str]:
    """The command of the bake; without `capture` what the output folder remembers."""
    words = [] if capture is None else [str(capture), "--profile", "relight", *(w for pair in SETTINGS for w in ("--set", pair))]
    return [sys.executable, "-m", "gsbake", "run", *words, "--out", str(out), "--threads", "1", "--quiet"]


def bake(capture: Path | None, out: Path, extra: Mapping[str, str] | None = None) -> End:
    """Run the bake to its end; `extra` environment variables."""
    environment = {**os.environ, **(extra or {})}
    done = subprocess.run(
        command(capture, out), env=environment, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False
    )
    return End(done.returncode, done.stdout + done.stderr)


def interrupted(capture: Path, out: Path, number: int, seconds: float, child: bool = False) -> End:
    """Run the bake and send it (or, with `child`, its newest stage process) a signal after so many seconds."""
    process = subprocess.Popen(command(capture, out), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
    time.sleep(seconds)
    target = process.pid
    if child:
        children = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=False).stdout.split()
        target = int(children[-1]) if children else process.pid
    if process.poll() is None:
        os.kill(target, number)
    text, _ = process.communicate(timeout=TIMEOUT)
    return End(process.returncode, text)


def digests(out: Path) -> dict[str, str]:
    """{file: digest} of every published file that the bake determines; the report holds run times."""
    found = {}
    for stage in STAGES:
        for path in sorted((out / "stages" / stage).glob("????????????????/**/*")):
            if path.is_file() and path.name != "manifest.json":
                found[path.relative_to(out).as_posix()] = hashlib.blake2b(path.read_bytes()).hexdigest()
    for name in ("asset.glb", "cameras.json", "light.hdr"):
        beside = out / name.replace(".", ".new.")  # a damaged result is taken for one that the user edited
        found[name] = hashlib.blake2b((beside if beside.exists() else out / name).read_bytes()).hexdigest()
    return found


@dataclass(frozen=True)
class Reference:
    """An undisturbed run: capture, output folder, digests of its files, and its run time in seconds."""

    capture: Path
    out: Path
    files: Mapping[str, str]
    seconds: float

    def copy(self, folder: Path) -> Path:
        """A copy of the finished output folder, with its times."""
        shutil.copytree(self.out, folder, symlinks=True)
        return folder

    def unfinished(self, folder: Path, stage: str) -> Path:
        """A copy in which `stage` and all later ones have not run."""
        self.copy(folder)
        for name in STAGES[STAGES.index(stage) :]:
            shutil.rmtree(folder / "stages" / name)
        return folder

    def check(self, out: Path, what: str) -> str:
        """Run the bake again in `out`: "recovered" with the reference's bytes, or "refused" with a documented sentence.

        Raises AssertionError for anything else.
        """
        end = bake(self.capture, out)
        if end.refused:
            return "refused"
        assert end.code == 0, f"{what}: exit {end.code}\n{end.text[-3000:]}"
        changed = {name for name, digest in digests(out).items() if self.files.get(name) != digest}
        assert not changed and set(self.files) <= set(digests(out)), f"{what}: other bytes in {sorted(changed)[:5]}"
        return "recovered"


def undisturbed(root: Path) -> Reference:
    """Write the capture and bake it."""
    capture, out = root / "capture", root / "out"
    words = ["synth", str(capture), "--views", "12", "--size", "96"]
    done = subprocess.run([sys.executable, "-m", "gsbake", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    begin = time.monotonic()
    end = bake(capture, out)
    assert end.code == 0, end.text[-3000:]
    return Reference(capture, out, digests(out), time.monotonic() - begin)


def work_files(out: Path) -> list[Path]:
    """Every file of the work folder except locks."""
    return sorted(path for path in out.rglob("*") if path.is_file() and path.suffix != ".lock")


def damage(path: Path, kind: str, rng: random.Random) -> None:
    """Truncate, flip, empty or delete a file, or plant one beside it."""
    data = path.read_bytes()
    match kind:
        case "truncate":
            path.write_bytes(data[: rng.randrange(max(1, len(data)))])
        case "flip":
            changed = bytearray(data or b"\0")
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
            path.write_bytes(bytes(changed))
        case "empty":
            path.write_bytes(b"")
        case "delete":
            path.unlink()
        case "plant":
            path.with_name(rng.choice(["emissive.exr", "planted.bin", "manifest.json.bak", "texture.png"])).write_bytes(b"stranger")


SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM}
