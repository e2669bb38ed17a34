"""The similarity between the world and the unit frame, in which the object fills most of the unit sphere.

With masks the visual hull says where the object is; without, what the cameras look at does: the point closest to all optical axes,
and around it the points that most photos show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.photos.decode import Bytes
from gsbake.geometry.cameras import Array, Camera, Similarity

#: Radius of the object in the unit frame: a margin of 10 % stays to the unit sphere.
UNIT_RADIUS = 0.9
_COARSE, _FINE = 48, 96
_PASSES = 4


@dataclass(frozen=True)
class Extent:
    """A ball around the object: `centre` (3,) and `radius` in world units, and how it was found, in words."""

    centre: Array
    radius: float
    evidence: str

    def similarity(self) -> Similarity:
        """unit → world."""
        return Similarity(self.radius / UNIT_RADIUS, np.eye(3), np.asarray(self.centre, float))


def looked_at(cameras: Sequence[Camera]) -> Array:
    """The point (3,) closest to the optical axes of all cameras, by least squares with outlying cameras weighted down.

    Of parallel axes the point is the one nearest to the cameras' mean position.
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


def _frame_radius(camera: Camera, point: Array) -> float:
    """Radius of the ball around `point` that just fits the camera's shorter side; inf when the point is behind the camera."""
    depth = float((camera.R @ point + camera.t)[2])
    return depth * 0.5 * min(camera.width / camera.fx, camera.height / camera.fy) if depth > 0 else np.inf


def extent_from_view(cameras: Sequence[Camera], points: Array | None) -> Extent:
    """The ball that the cameras look at, from their axes and the SfM points (n, 3) most of them show."""
    point = looked_at(cameras)
    distances = np.array([np.linalg.norm(c.centre - point) for c in cameras])
    fits = np.array([_frame_radius(c, point) for c in cameras])
    fits = fits[np.isfinite(fits)]
    if not fits.size:  # cameras that look apart: take in what lies in front of them
        centres = np.stack([c.centre for c in cameras])
        spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
        return Extent(centres.mean(0), max(spread, 1e-6), "camera positions")
    frame = float(np.median(fits))
    limit = 0.9 * max(float(np.quantile(distances, 0.1)), 1e-6)
    if points is not None and len(points) >= 50:
        shown = np.zeros(len(points))
        for camera in cameras:
            pixel, depth = camera.project(points)
            inner = np.abs(pixel - (camera.width / 2, camera.height / 2)) < (0.45 * camera.width, 0.45 * camera.height)
            shown += (depth > 0) & inner.all(1)
        # Objects are framed by both sides of a photo: an upright one reaches farther than the shorter side of a portrait tells.
        reach = 1.2 * frame * float(np.median([(c.width * c.height) ** 0.5 / min(c.width, c.height) for c in cameras]))
        near = np.linalg.norm(points - point, axis=1) < reach
        common = points[near & (shown >= 0.6 * len(cameras))]
        if len(common) >= 50:
            low, high = np.quantile(common, [0.02, 0.98], axis=0)
            centre = 0.5 * (low + high)
            # Points are found on texture; the object reaches beyond them (a fox's ears, say).
            radius = 1.2 * float(np.quantile(np.linalg.norm(common - centre, axis=1), 0.98))
            return Extent(centre, min(max(radius, 0.2 * frame), limit, reach), f"{len(common)} points that most photos show")
    return Extent(point, min(0.85 * frame, limit), "where the cameras look")


def extent_from_masks(cameras: Sequence[Camera], masks: Sequence[Bytes]) -> Extent | None:
    """The ball around the visual hull, or None when the masks leave nothing (wrong masks or wrong poses).

    `masks` (h, w) have their cameras' sizes. The hull is carved coarsely in all that the cameras see and again in the ball found, until
    that stands still.
    """
    centre = looked_at(cameras)
    fits = [_frame_radius(c, centre) for c in cameras]
    finite = [f for f in fits if np.isfinite(f)]
    if not finite:
        return None
    radius = 2.0 * float(np.median(finite))
    for step in range(_PASSES):
        hull = Hull.of(cameras, masks, centre, radius, _FINE if step else _COARSE)
        if hull.empty:
            return None
        where = hull.lower + (np.argwhere(hull.occupancy) + 0.5) * hull.cell
        low, high = where.min(0), where.max(0)
        centre = 0.5 * (low + high)
        tight = float(np.linalg.norm(where - centre, axis=1).max()) + 0.5 * hull.cell
        done = step > 0 and tight > 0.75 * radius
        radius = 1.1 * tight
        if done:
            break
    return Extent(centre, radius / 1.1, f"visual hull of {len(masks)} masks")
