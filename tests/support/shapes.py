"""Silhouettes of a curved bar, which looks different from every side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsbake.geometry.cameras import Camera


def bar_masks(folder: Path, cameras: Sequence[Camera]) -> dict[str, Path]:
    """Write the silhouettes, 255 = bar, into `folder`; the files by the cameras' names."""
    folder.mkdir(parents=True, exist_ok=True)
    t = np.linspace(-1, 1, 60)
    line = np.stack([0.8 * t, 0.5 * t**2, 0.4 * t], 1)
    rng = np.random.default_rng(0)
    points = (line[:, None] + 0.15 * rng.normal(size=(60, 200, 3)) / 2).reshape(-1, 3)
    files = {}
    for camera in cameras:
        mask = np.zeros((camera.height, camera.width), np.uint8)
        at = np.round(camera.project(points)[0]).astype(int)
        mask[at[:, 1], at[:, 0]] = 255
        files[camera.name] = folder / f"{camera.name}.png"
        cv2.imwrite(str(files[camera.name]), cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    return files
