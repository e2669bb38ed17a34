"""Parts too thin for the visual hull's grid: struts, antennas, wires and rims that masks show and cells pass by.

A hull on cells of some width keeps what is as wide as they are. Whether there is anything thinner, the masks tell: what a mask loses when
it is opened by a disc as wide as a cell is thin (Serra, *Image analysis and mathematical morphology*, 1982). Only then a finer hull is
carved, and its surface counts where the coarse one has nothing.
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

#: Share of the masks' pixels that must be thin.
LEAST = 0.002
#: Cells of the finer hull along an edge.
FINE = 256
#: A point of the finer hull is on a part of its own so many cells of the coarse hull away from that; points that stand for that one.
OUTSIDE, DENSE = 0.75, 200_000


@dataclass(frozen=True)
class Thin:
    """`points` (n, 3) on thin parts, unit frame, with outward unit `normals` (n, 3); `share` of the masks' pixels that is thin."""

    points: Array
    normals: Array
    share: float

    def save(self, path: Path) -> None:
        """Write a NumPy archive."""
        np.savez(path, points=self.points.astype(np.float32), normals=self.normals.astype(np.float32))


def load_thin(path: Path) -> tuple[Array, Array]:
    """Points and normals (n, 3) that `Thin.save` wrote."""
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
        kept = cv2.morphologyEx(solid, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (disc, disc)))
        lost, total = lost + int(solid.sum() - kept.sum()), total + int(solid.sum())
    return lost / max(total, 1)


def find_thin(posed: PosedPhotos, hull: Hull, count: int, seed: int) -> Thin:
    """Points on parts too thin for `hull` of a masked capture, as dense as `count` points all over the finer hull would be."""
    share, nothing = thin_share(posed, hull.cell), np.zeros((0, 3))
    if share < LEAST:
        return Thin(nothing, nothing, share)
    fine = visual_hull(posed, FINE)
    if fine.empty:
        return Thin(nothing, nothing, share)
    points, normals = fine.surface_points(count, seed)
    own = cKDTree(hull.surface_points(DENSE, seed)[0]).query(points)[0] > OUTSIDE * hull.cell
    return Thin(points[own], normals[own], share)
