"""Hostile captures on disk, as the poses stage writes them: photos, masks and cameras by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from tests.support.cameras import look_at

SIZE = 64


def around(distance: float = 3.0, focal: float = 90.0, count: int = 6) -> list[Camera]:
    """Cameras on an arc of 15 degrees a step."""
    angles = np.radians(15.0) * np.arange(count)
    return [
        look_at((distance * np.cos(a), distance * np.sin(a), 0.3 * distance), size=SIZE, focal=focal, name=f"{i:02d}")
        for i, a in enumerate(angles)
    ]


def away() -> list[Camera]:
    return [replace(c, R=c.R * [[-1], [1], [-1]], t=c.t * [-1, 1, -1]) for c in around()]


CAMERAS: dict[str, Callable[[], list[Camera]]] = {
    "plain": around,
    "at one place": lambda: [replace(around()[0], name=f"{i:02d}") for i in range(6)],
    "looking away": away,
    "inside the object": lambda: around(0.1),
    "far away": lambda: around(1e6, focal=3e7),
    "on the surface": lambda: around(1e-6),
    "tiny focal length": lambda: around(focal=1e-3),
    "huge focal length": lambda: around(focal=1e9),
    "on one line": lambda: [look_at((2.0 + 0.3 * i, 0, 0), size=SIZE, focal=90, name=f"{i:02d}") for i in range(6)],
    "one": lambda: around(count=1),
}


def photos(kind: str, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    values = {"black": 0, "white": 255, "grey": 128}
    return [
        np.full((SIZE, SIZE, 3), values[kind], np.uint8) if kind in values else rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8)
        for _ in range(count)
    ]


def masks(kind: str, count: int) -> list[np.ndarray] | None:
    v, u = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    shapes = {"empty": np.zeros((SIZE, SIZE)), "full": np.ones((SIZE, SIZE)), "disc": np.hypot(u, v) < SIZE / 4}
    if kind == "none":
        return None
    if kind == "one pixel":
        shapes[kind] = np.zeros((SIZE, SIZE))
        shapes[kind][SIZE // 2, SIZE // 2] = 1
    if kind == "alternating":
        return [(255 * shapes["disc" if i % 2 else "empty"]).astype(np.uint8) for i in range(count)]
    return [(255 * shapes[kind]).astype(np.uint8)] * count


PHOTOS = ("noise", "black", "white", "grey")
MASKS = ("disc", "none", "empty", "full", "one pixel", "alternating")


def write(
    folder: Path, cameras: Sequence[Camera], pictures: Sequence[np.ndarray], outlines: Sequence[np.ndarray] | None,
    to_world: Similarity | None = None,
) -> Path:  # fmt: skip
    """The artifact folder of the poses stage; returns it."""
    for name in ("photos", "masks"):
        (folder / name).mkdir(parents=True)
    CameraSet(tuple(cameras), to_world or Similarity()).save(folder / "cameras.json")
    for camera, picture in zip(cameras, pictures, strict=True):
        cv2.imwrite(str(folder / "photos" / f"{camera.name}.png"), picture)
    for camera, outline in zip(cameras, outlines or (), strict=False):
        cv2.imwrite(str(folder / "masks" / f"{camera.name}.png"), outline)
    return folder
