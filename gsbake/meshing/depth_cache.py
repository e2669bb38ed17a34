"""Disk cache of depth views between the fusion passes; memory does not grow with the number of photos."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsbake.geometry.cameras import Camera
from gsbake.meshing.depth_views import DepthView, Floats


class DepthViewCache:
    """Depth views with their normals, written once and read one at a time.

    `folder` must exist. Inverse depth is stored as float32; weights, cosines and mask distances as float16; normals as int8 (0.4° steps).
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._cameras: list[Camera] = []

    def __len__(self) -> int:
        return len(self._cameras)

    def append(self, view: DepthView, normal: Floats) -> None:
        """Write a view and its unit normals (h, w, 3)."""
        base = self._folder / f"{len(self._cameras):05d}"
        half_maps = np.stack([view.weight, view.cosine, np.minimum(view.mask_distance, 60000)]).astype(np.float16)
        np.save(f"{base}.inverse.npy", view.inverse)
        np.save(f"{base}.soft.npy", half_maps)
        np.save(f"{base}.normal.npy", np.rint(np.clip(normal, -1, 1) * 127).astype(np.int8))
        self._cameras.append(view.camera)

    def view(self, index: int) -> DepthView:
        """View `index`."""
        base = self._folder / f"{index:05d}"
        weight, cosine, mask_distance = np.load(f"{base}.soft.npy").astype(np.float32)
        return DepthView(self._cameras[index], np.load(f"{base}.inverse.npy"), weight, cosine, mask_distance)

    def normal(self, index: int) -> Floats:
        """Normals (h, w, 3) of view `index`."""
        return np.load(self._folder / f"{index:05d}.normal.npy").astype(np.float32) / np.float32(127)

    def __iter__(self) -> Iterator[DepthView]:
        return (self.view(index) for index in range(len(self)))
