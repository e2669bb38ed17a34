"""A stand-in for the engine: runs a stage in a folder and keeps what it said."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsbake.capture.sources import discover
from gsbake.config.schema import Profile

CAPTURES = Path(os.environ.get("GSBAKE_CAPTURES", Path(__file__).resolve().parents[3] / "shared" / "captures"))


class FakeContext:
    """The Context of a stage under test; `warnings` and `decisions` keep what it reported."""

    def __init__(self, out: Path, inputs: Mapping[str, Path], settings: Any, checkpoint: Path) -> None:
        out.mkdir(parents=True)
        checkpoint.mkdir(parents=True, exist_ok=True)
        self.out, self.inputs, self.settings, self.checkpoint = out, inputs, settings, checkpoint
        self.seed, self.threads, self.device = 0, 2, "cpu"
        self.warnings: list[str] = []
        self.decisions: dict[str, str] = {}
        self.parts: dict[str, float] = {}
        self.progressed: list[tuple[int, int, str]] = []

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.parts[name] = self.parts.get(name, 0.0) + time.perf_counter() - start

    def progress(self, done: int, total: int, text: str = "", **live: float) -> None:
        self.progressed.append((done, total, text))

    def stop_requested(self) -> bool:
        return False

    def check_stop(self) -> None:
        return None

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        self.decisions[what] = f"{choice} ({evidence})"

    def warn(self, text: str) -> None:
        self.warnings.append(text)


class Runner:
    """Runs ingest and poses on a folder of photos."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def ingest(
        self, photos: Path, masks: Path | None = None, poses: Path | None = None, skip: Mapping[str, str] | None = None, **settings: Any
    ) -> tuple[dict[str, Any], FakeContext]:
        from gsbake.stages.ingest import run

        found = discover(photos, masks, poses)
        inputs = {k: v for k, v in {"photos": found.photos, "masks": found.masks, "poses": found.poses}.items() if v is not None}
        ctx = FakeContext(self.root / "ingest", inputs, Profile.model_validate({"ingest": settings, "skip": skip or {}}), self.root / "c1")
        return run(ctx), ctx

    def poses(self, skip: Mapping[str, str] | None = None, **settings: Any) -> tuple[dict[str, Any], FakeContext]:
        from gsbake.stages.poses import run

        profile = Profile.model_validate({"poses": settings, "skip": skip or {}})
        ctx = FakeContext(self.root / "poses", {"ingest": self.root / "ingest"}, profile, self.root / "c2")
        return run(ctx), ctx


@pytest.fixture
def runner(tmp_path: Path) -> Runner:
    """Runs stages below the test's folder."""
    return Runner(tmp_path / "run")


@pytest.fixture
def captures() -> Path:
    """The shared captures; the test is skipped where they are not."""
    if not CAPTURES.is_dir():
        pytest.skip("shared captures are not here")
    return CAPTURES


def picture(seed: int, height: int = 48, width: int = 64) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A smooth random RGB picture, different for every seed."""
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
