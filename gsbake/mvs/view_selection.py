"""Which photos a photo is matched against: those that see the same surface 5 to 30 degrees away.

Fewer degrees say little about depth, more change the picture too much (Goesele et al., *Multi-view stereo for community photo collections*,
ICCV 2007). The angle is measured at sample points of the object, as COLMAP does at tie points; where tie points are few
the samples are the hull's surface, or the middle of the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsbake.geometry.cameras import Array, Camera

#: The best angle between two views, and how fast a smaller or larger one loses worth (degrees).
BEST_ANGLE, NARROWER, WIDER = 14.0, 6.0, 12.0
#: Pairs farther apart than this are not matched; up to the second, their depth maps may still confirm one another.
MOST_ANGLE, MOST_AGREE_ANGLE = 45.0, 75.0
#: Fewer samples than this in common say nothing.
LEAST_SHARED = 12
#: A neighbour loses up to this share of its worth to one already chosen that looks from the same place.
CROWDED = 0.7


def pair_worth(cameras: Sequence[Camera], points: Array, normals: Array | None) -> tuple[Array, Array]:
    """Worth (n, n) of each pair for matching and their median angle in degrees (n, n; 180 where nothing is shared).

    `points` (k, 3) are samples of the surface, `normals` (k, 3) outward or None when unknown.
    """
    count = len(cameras)
    centres = np.stack([c.centre for c in cameras])
    sees = np.zeros((count, len(points)), bool)
    rays = np.zeros((count, len(points), 3))
    for i, camera in enumerate(cameras):
        pixel, z = camera.project(points)
        sees[i] = camera.shows(pixel, z)
        ray = centres[i] - points
        rays[i] = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
        if normals is not None:
            sees[i] &= (rays[i] * normals).sum(1) > 0.25
    worth, angles = np.zeros((count, count)), np.full((count, count), 180.0)
    focal = np.array([c.fx for c in cameras])
    for i in range(count):
        for j in range(i + 1, count):
            both = sees[i] & sees[j]
            if both.sum() < min(LEAST_SHARED, len(points)):
                continue
            angle = np.degrees(np.arccos(np.clip((rays[i, both] * rays[j, both]).sum(1), -1, 1)))
            gap = angle - BEST_ANGLE
            worth_each = np.exp(-(gap**2) / (2 * np.where(gap < 0, NARROWER, WIDER) ** 2))
            # A view that resolves the surface half as finely has half the worth.
            far_i = np.linalg.norm(points[both] - centres[i], axis=1) / focal[i]
            far_j = np.linalg.norm(points[both] - centres[j], axis=1) / focal[j]
            worth_each *= np.minimum(far_i / far_j, far_j / far_i)
            worth[i, j] = worth[j, i] = worth_each.sum() / max(sees[i].sum(), sees[j].sum(), 1)
            angles[i, j] = angles[j, i] = float(np.median(angle))
    return worth, angles


def choose(
    cameras: Sequence[Camera], points: Array, normals: Array | None, matched: int, agreeing: int
) -> tuple[list[list[int]], list[list[int]]]:
    """For each photo the neighbours it is matched against (at most `matched`), and those whose depths may confirm it (at most `agreeing`).

    Both lists start with the best; a photo without any neighbour has empty lists. Among the matched ones, views from
    the same direction are worth less, so that some view sees past an edge on either side.
    """
    worth, angles = pair_worth(cameras, points, normals)
    centres = np.stack([c.centre for c in cameras])
    first, second = [], []
    for i in range(len(cameras)):
        usable = {j for j in range(len(cameras)) if j != i and worth[i, j] > 0 and angles[i, j] <= MOST_ANGLE}
        ways = centres - centres[i]
        ways = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
        chosen: list[int] = []
        while usable and len(chosen) < matched:
            crowd = {j: max([float(ways[j] @ ways[k]) for k in chosen], default=0.0) for j in usable}
            best = max(sorted(usable), key=lambda j: worth[i, j] * (1 - CROWDED * max(0.0, crowd[j])))
            chosen.append(best)
            usable.remove(best)
        first.append(chosen)
        near = sorted((j for j in range(len(cameras)) if j != i and angles[i, j] <= MOST_AGREE_ANGLE), key=lambda j: (angles[i, j], j))
        second.append(chosen + [j for j in near if j not in chosen][: max(0, agreeing - len(chosen))])
    return first, second
