"""Thin parts that the visual hull's grid misses: struts, antennas, wires and rims.

A hull resolves only parts at least as wide as its cells. Thinner parts are detected in the masks: they vanish under a morphological opening
by a disc as wide as a cell (Serra, *Image analysis and mathematical morphology*, 1982). Only then a finer hull is carved, and its surface
is used where the coarse one has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from gsbake.capture.hull.visual_hull import Hull, visual_hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Array

#: Minimum share of the masks' pixels that are on thin parts.
MIN_THIN_SHARE = 0.002
#: Resolution of the finer hull: cells along an edge.
FINE_RESOLUTION = 256
#: A point of the finer hull is on a thin part when it is farther than this many cells from the coarse hull's surface; number of points that
#: sample that surface.
MIN_DISTANCE_CELLS, COARSE_SAMPLES = 0.75, 200_000


@dataclass(frozen=True)
class ThinParts:
    """`points` (n, 3) on thin parts, unit frame, with outward unit `normals` (n, 3); `share` of the masks' pixels on thin parts."""

    points: Array
    normals: Array
    share: float

    def save(self, path: Path) -> None:
        """Write a NumPy archive."""
        np.savez(path, points=self.points.astype(np.float32), normals=self.normals.astype(np.float32))


def load_thin_parts(path: Path) -> tuple[Array, Array]:
    """Points and normals (n, 3) that `ThinParts.save` wrote."""
    with np.load(path, allow_pickle=False) as data:
        return data["points"].astype(float), data["normals"].astype(float)


def thin_share(posed: PosedPhotos, width: float) -> float:
    """Share of the masks' pixels in parts narrower than `width` (unit frame, at the distance of the origin)."""
    lost = total = 0
    for index in range(len(posed)):
        camera, mask = posed.mask(index)
        if mask is None:
            continue
        disc = round(width * 0.5 * (camera.fx + camera.fy) / max(float(np.linalg.norm(camera.centre)), 1e-6)) | 1
        solid = (mask > 127).astype(np.uint8)
        if disc > max(mask.shape):  # a camera at the object: the whole photo is narrower, and the disc may not fit into memory
            lost, total = lost + int(solid.sum()), total + int(solid.sum())
            continue
        opened = cv2.morphologyEx(solid, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (disc, disc)))
        lost, total = lost + int(solid.sum() - opened.sum()), total + int(solid.sum())
    return lost / max(total, 1)


def find_thin_parts(posed: PosedPhotos, hull: Hull, count: int, seed: int) -> ThinParts:
    """Points on parts of a masked capture too thin for `hull`, at the density of `count` points over the whole finer hull."""
    share, none = thin_share(posed, hull.cell), np.zeros((0, 3))
    if share < MIN_THIN_SHARE:
        return ThinParts(none, none, share)
    fine = visual_hull(posed, FINE_RESOLUTION)
    if fine.empty:
        return ThinParts(none, none, share)
    points, normals = fine.surface_points(count, seed)
    on_thin_parts = cKDTree(hull.surface_points(COARSE_SAMPLES, seed)[0]).query(points)[0] > MIN_DISTANCE_CELLS * hull.cell
    return ThinParts(points[on_thin_parts], normals[on_thin_parts], share)
