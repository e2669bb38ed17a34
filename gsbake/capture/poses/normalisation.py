"""Normalisation to the unit frame: the similarity that maps the object into the unit sphere.

The object is located by the visual hull of the masks. Without masks it is located by the point nearest to all optical axes and the tie
points around it that most photos show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsbake.capture.hull.visual_hull import MAX_INCONSISTENT_SHARE, Hull
from gsbake.capture.photos.decode import Bytes
from gsbake.geometry.cameras import Array, Camera, Similarity

#: Radius of the object in the unit frame: leaves a margin of 10 % to the unit sphere.
UNIT_RADIUS = 0.9
#: Cells along the edge of the hull in the first and in later passes, and the most passes.
_COARSE_CELLS, _FINE_CELLS = 48, 96
_MAX_PASSES = 4


@dataclass(frozen=True)
class BoundingSphere:
    """Bounding sphere of the object: `centre` (3,) and `radius` in world units, and the evidence it is based on."""

    centre: Array
    radius: float
    evidence: str

    def similarity(self) -> Similarity:
        """The map from the unit frame to the world."""
        return Similarity(self.radius / UNIT_RADIUS, np.eye(3), np.asarray(self.centre, float))


def nearest_point_to_axes(cameras: Sequence[Camera]) -> Array:
    """The point (3,) nearest to the optical axes of all cameras, by iteratively reweighted least squares (Cauchy weights).

    For parallel axes, the solution nearest to the cameras' mean position.
    """
    directions = np.stack([c.view_direction for c in cameras])
    centres = np.stack([c.centre for c in cameras])
    planes = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = np.ones(len(cameras))
    point = centres.mean(0)
    for _ in range(10):
        normal = np.einsum("n,nij->ij", weights, planes)
        right = np.einsum("n,nij,nj->i", weights, planes, centres - centres.mean(0))
        point = np.linalg.lstsq(normal, right, rcond=1e-6)[0] + centres.mean(0)
        misses = np.linalg.norm(np.einsum("nij,nj->ni", planes, point - centres), axis=1)
        scale = max(float(np.median(misses)), 1e-12)
        weights = 1.0 / (1.0 + (misses / (2 * scale)) ** 2)
    return np.asarray(point)


def frame_radius(camera: Camera, point: Array) -> float:
    """Radius of the sphere around `point` that fits the camera's shorter side; inf when the point is behind the camera."""
    depth = float((camera.R @ point + camera.t)[2])
    return depth * 0.5 * min(camera.width / camera.fx, camera.height / camera.fy) if depth > 0 else np.inf


def bounding_sphere_from_views(cameras: Sequence[Camera], points: Array | None) -> BoundingSphere:
    """Bounding sphere from the optical axes and the tie points (n, 3) that most cameras show."""
    point = nearest_point_to_axes(cameras)
    distances = np.array([np.linalg.norm(c.centre - point) for c in cameras])
    fits = np.array([frame_radius(c, point) for c in cameras])
    fits = fits[np.isfinite(fits)]
    if not fits.size:  # the axes diverge: fall back to the camera positions
        centres = np.stack([c.centre for c in cameras])
        spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
        return BoundingSphere(centres.mean(0), max(spread, 1e-6), "camera positions")
    frame = float(np.median(fits))
    limit = 0.9 * max(float(np.quantile(distances, 0.1)), 1e-6)
    if points is not None and len(points) >= 50:
        shown = np.zeros(len(points))
        for camera in cameras:
            pixel, depth = camera.project(points)
            inner = np.abs(pixel - (camera.width / 2, camera.height / 2)) < (0.45 * camera.width, 0.45 * camera.height)
            shown += (depth > 0) & inner.all(1)
        # Both sides of a photo frame the object: a tall object exceeds the sphere that fits the shorter side of a portrait photo.
        reach = 1.2 * frame * float(np.median([(c.width * c.height) ** 0.5 / min(c.width, c.height) for c in cameras]))
        near = np.linalg.norm(points - point, axis=1) < reach
        common = points[near & (shown >= 0.6 * len(cameras))]
        if len(common) >= 50:
            low, high = np.quantile(common, [0.02, 0.98], axis=0)
            centre = 0.5 * (low + high)
            # Tie points lie on texture only; the object extends beyond them.
            radius = 1.2 * float(np.quantile(np.linalg.norm(common - centre, axis=1), 0.98))
            return BoundingSphere(centre, min(max(radius, 0.2 * frame), limit, reach), f"{len(common)} points that most photos show")
    return BoundingSphere(point, min(0.85 * frame, limit), "optical axes of the cameras")


def bounding_sphere_from_masks(
    cameras: Sequence[Camera], masks: Sequence[Bytes], max_inconsistent_share: float = MAX_INCONSISTENT_SHARE
) -> BoundingSphere | None:
    """Bounding sphere of the visual hull, or None when the hull is empty (wrong masks or wrong poses).

    `masks` (h, w) have their cameras' sizes; `max_inconsistent_share` of a point's views may exclude it. The hull is carved coarsely in the
    common field of view, then repeatedly in its own bounding sphere until that converges.
    """
    centre = nearest_point_to_axes(cameras)
    fits = [frame_radius(c, centre) for c in cameras]
    finite = [f for f in fits if np.isfinite(f)]
    if not finite:
        return None
    radius = 2.0 * float(np.median(finite))
    for step in range(_MAX_PASSES):
        hull = Hull.from_masks(cameras, masks, centre, radius, _FINE_CELLS if step else _COARSE_CELLS, max_inconsistent_share)
        if hull.empty:
            return None
        occupied = hull.centres()
        low, high = occupied.min(0), occupied.max(0)
        centre = 0.5 * (low + high)
        tight = float(np.linalg.norm(occupied - centre, axis=1).max()) + 0.5 * hull.cell
        converged = step > 0 and tight > 0.75 * radius
        radius = 1.1 * tight
        if converged:
            break
    return BoundingSphere(centre, radius / 1.1, f"visual hull of {len(masks)} masks")
