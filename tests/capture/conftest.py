"""Ingestion and pose estimation in a folder of the test, with recorded reports."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsbake.capture.estimate_poses import PoseOptions, estimate_poses
from gsbake.capture.ingest import IngestOptions, ingest
from gsbake.capture.sources import discover
from gsbake.config.schema import Ingest, Poses
from gsbake.monitor import Rule
from tests.support.recorder import Recorder

CAPTURES = Path(os.environ.get("GSBAKE_CAPTURES", Path(__file__).resolve().parents[3] / "shared" / "captures"))


class Done(Recorder):
    """Reports of a step, and its output folder."""

    def __init__(self, out: Path) -> None:
        super().__init__()
        self.out = out
        out.mkdir(parents=True)


class Runner:
    """Ingests a capture and estimates its poses."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def ingest(
        self, photos: Path, masks: Path | None = None, poses: Path | None = None, resolution: Rule = "auto",
        settings: Mapping[str, Any] | None = None, **more: Any,
    ) -> tuple[dict[str, Any], Done]:  # fmt: skip
        found, done = discover(photos, masks, poses), Done(self.root / "ingest")
        # The network only where a test asks for it: with and without its weights the other tests do the same.
        options = IngestOptions(Ingest(**{"mask_network": "none", **(settings or {}), **more}), resolution)
        return ingest(found.photos, done.out, options, masks=found.masks, poses=found.poses, monitor=done), done

    def poses(
        self, redundant_photos: Rule = "auto", out: str = "poses", threads: int = 2, cache: Path | None = None, **settings: Any
    ) -> tuple[dict[str, Any], Done]:  # fmt: skip
        done, scratch = Done(self.root / out), self.root / f"scratch of {out}"
        scratch.mkdir(exist_ok=True)
        options = PoseOptions(Poses(**settings), redundant_photos)
        figures = estimate_poses(self.root / "ingest", done.out, options, threads=threads, scratch=scratch, cache=cache, monitor=done)
        return figures, done


@pytest.fixture
def runner(tmp_path: Path) -> Runner:
    """Runner of stages in the test's folder."""
    return Runner(tmp_path / "run")


@pytest.fixture
def captures() -> Path:
    """The shared captures; the test is skipped where they are missing."""
    if not CAPTURES.is_dir():
        pytest.skip("the shared captures are missing")
    return CAPTURES


def picture(seed: int, height: int = 48, width: int = 64) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A smooth random RGB image of this seed."""
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
