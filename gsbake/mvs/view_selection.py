"""View selection: each photo is matched against photos that see the same surface from 5 to 30 degrees away.

Smaller triangulation angles determine depth poorly, larger ones change the appearance too much (Goesele et al., *Multi-view stereo for
community photo collections*, ICCV 2007). The angle is measured at sample points of the object, as COLMAP does at tie points; where tie
points are few, the samples are the hull's surface or the object's centre.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsbake.geometry.cameras import Array, Camera

#: Best triangulation angle, and standard deviations of the score below and above it (degrees).
BEST_ANGLE, SIGMA_BELOW, SIGMA_ABOVE = 14.0, 6.0, 12.0
#: Largest angle between matched views, and between views whose depth maps are checked against one another (degrees).
MAX_MATCHING_ANGLE, MAX_CONSISTENCY_ANGLE = 45.0, 75.0
#: Minimum number of sample points that two views share.
MIN_SHARED_POINTS = 12
#: Share of its score that a view loses to a selected view in the same direction.
REDUNDANCY_PENALTY = 0.7


def pair_scores(cameras: Sequence[Camera], points: Array, normals: Array | None) -> tuple[Array, Array]:
    """Matching score (n, n) of each pair of views and their median angle in degrees (n, n; 180 where no samples are shared).

    `points` (k, 3) are samples of the surface, `normals` (k, 3) outward or None when unknown.
    """
    count = len(cameras)
    centres = np.stack([c.centre for c in cameras])
    visible = np.zeros((count, len(points)), bool)
    rays = np.zeros((count, len(points), 3))
    for i, camera in enumerate(cameras):
        pixel, z = camera.project(points)
        visible[i] = camera.in_view(pixel, z)
        ray = centres[i] - points
        rays[i] = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
        if normals is not None:
            visible[i] &= (rays[i] * normals).sum(1) > 0.25
    score, angles = np.zeros((count, count)), np.full((count, count), 180.0)
    focal = np.array([c.fx for c in cameras])
    for i in range(count):
        for j in range(i + 1, count):
            shared = visible[i] & visible[j]
            if shared.sum() < min(MIN_SHARED_POINTS, len(points)):
                continue
            angle = np.degrees(np.arccos(np.clip((rays[i, shared] * rays[j, shared]).sum(1), -1, 1)))
            gap = angle - BEST_ANGLE
            score_each = np.exp(-(gap**2) / (2 * np.where(gap < 0, SIGMA_BELOW, SIGMA_ABOVE) ** 2))
            # The score is proportional to the ratio of the resolutions on the surface.
            far_i = np.linalg.norm(points[shared] - centres[i], axis=1) / focal[i]
            far_j = np.linalg.norm(points[shared] - centres[j], axis=1) / focal[j]
            score_each *= np.minimum(far_i / far_j, far_j / far_i)
            score[i, j] = score[j, i] = score_each.sum() / max(visible[i].sum(), visible[j].sum(), 1)
            angles[i, j] = angles[j, i] = float(np.median(angle))
    return score, angles


def select_views(
    cameras: Sequence[Camera], points: Array, normals: Array | None, matched: int, consistent: int
) -> tuple[list[list[int]], list[list[int]]]:
    """For each photo its source views (at most `matched`) and the views that its depths are checked against (at most `consistent`).

    Both lists start with the best view and are empty for a photo without neighbours. Source views in the same direction lose score, so
    that one of them sees past an edge on either side.
    """
    score, angles = pair_scores(cameras, points, normals)
    centres = np.stack([c.centre for c in cameras])
    sources, checks = [], []
    for i in range(len(cameras)):
        usable = {j for j in range(len(cameras)) if j != i and score[i, j] > 0 and angles[i, j] <= MAX_MATCHING_ANGLE}
        directions = centres - centres[i]
        directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        chosen: list[int] = []
        while usable and len(chosen) < matched:
            redundancy = {j: max([float(directions[j] @ directions[k]) for k in chosen], default=0.0) for j in usable}
            best = max(sorted(usable), key=lambda j: score[i, j] * (1 - REDUNDANCY_PENALTY * max(0.0, redundancy[j])))
            chosen.append(best)
            usable.remove(best)
        sources.append(chosen)
        nearby = (j for j in range(len(cameras)) if j not in (i, *chosen) and angles[i, j] <= MAX_CONSISTENCY_ANGLE)
        others = sorted(nearby, key=lambda j: (angles[i, j], j))
        checks.append(chosen + others[: max(0, consistent - len(chosen))])
    return sources, checks
