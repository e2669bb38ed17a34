"""The share of the object that stereo confirmed, and the training steps skipped for it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.surfels.training.step_budget import MIN_CONFIRMED_SHARE, can_skip_steps, confirmed_share, skipped_steps


def capture(folder: Path, masks: bool) -> PosedPhotos:
    """Three photos of 40 x 20 pixels with the object in the left half; in the first, half of it has a depth, in the second none."""
    (folder / "depth").mkdir(parents=True)
    (folder / "masks").mkdir()
    cameras = tuple(Camera(n, 40, 20, 30.0, 30.0, 20.0, 10.0, np.eye(3), np.array([0, 0, 3.0])) for n in ("a", "b", "without"))
    CameraSet(cameras).save(folder / "cameras.json")
    mask, depth = np.zeros((20, 40), np.uint8), np.zeros((10, 20), np.float32)
    mask[:, :20] = 255
    depth[:5, :10], depth[:5, 18:] = 2.0, 2.0
    for name, known in (("a", depth), ("b", 0 * depth)):
        np.savez(folder / "depth" / f"{name}.npz", depth=known, confidence=(known > 0).astype(np.float16))
    for name in ("a", "b", "without") if masks else ():
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), mask)
    return PosedPhotos.open(folder)


@pytest.mark.parametrize(("masks", "share"), [(True, 50 / 200), (False, 60 / 400)])
def test_confirmed_share_counts_the_objects_pixels(tmp_path: Path, masks: bool, share: float) -> None:
    posed = capture(tmp_path / "run", masks)
    assert confirmed_share(posed, tmp_path / "run") == pytest.approx(share)
    assert confirmed_share(posed, tmp_path) == 0.0


def test_steps_are_skipped_only_on_sufficient_evidence() -> None:
    assert can_skip_steps(MIN_CONFIRMED_SHARE + 0.01, "stereo", False)[0]
    assert not can_skip_steps(MIN_CONFIRMED_SHARE - 0.01, "stereo", False)[0]
    assert not can_skip_steps(0.9, "hull", False)[0] and not can_skip_steps(0.9, "stereo", True)[0]
    assert skipped_steps(1000, 0.6) == 300 and skipped_steps(1000, 1.0) == 500 and skipped_steps(1000, 0.0) == 0
