"""Points from pixel positions in photos: least squares over viewing rays, with covariance (Hartley & Zisserman, ch. 12)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.photos.undistortion import image_plane
from gsbake.config.lengths import PixelPosition
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera, CameraSet
from gsbake.text import shortlist

#: Assumed standard deviation of a pixel position that a person picked, in pixels of the working photo.
PICK_NOISE = 1.0
#: Smallest angle in degrees between two rays that determine a point.
MIN_ANGLE = 2.0
_STEPS = 10


@dataclass(frozen=True)
class Ray:
    """A viewing ray: origin (3,), unit direction (3,), and the angle in radians that one pixel of the photo covers."""

    origin: Array
    direction: Array
    pixel_angle: float


@dataclass(frozen=True)
class Point:
    """A point (3,), its covariance (3, 3), and the residuals (n,) of its rays in pixels."""

    position: Array
    covariance: Array
    residuals: Array


def camera_rays(camera: Camera, pixels: Array) -> list[Ray]:
    """Rays through `pixels` (n, 2) of the photo of `camera`, in the frame of its pose.

    Raises BadInputError where the distortion has no inverse.
    """
    plane = image_plane(camera, pixels)
    if not np.isfinite(plane).all():
        raise BadInputError(f"The lens distortion of photo {camera.name} cannot be inverted at a point that is measured there.")
    directions = np.column_stack([plane, np.ones(len(plane))]) @ camera.R
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [Ray(camera.centre, direction, 1 / camera.fx) for direction in directions]


@dataclass(frozen=True)
class PickedPhotos:
    """Cameras of the working photos by name, with distortion, and the `entries` of photos.json, which know the user's files; `what` is
    picked in them."""

    cameras: Mapping[str, Camera]
    entries: Sequence[Mapping[str, Any]]
    what: str = "a known distance"

    @classmethod
    def open(cls, ingest: Path, poses: Path, what: str) -> PickedPhotos:
        """Those of the artifact folders `ingest` and `poses`, in the world frame."""
        cameras = CameraSet.load(poses / "photo_cameras.json").cameras
        entries = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
        return cls({camera.name: camera for camera in cameras}, entries, what)

    def ray(self, position: PixelPosition) -> Ray:
        """The ray of a pixel position in the user's file."""
        return self.rays(position, np.zeros((1, 2)))[0]

    def rays(self, position: PixelPosition, offsets: Array) -> list[Ray]:
        """The rays of a pixel position in the user's file with `offsets` (n, 2), in shares of the photo's longer side. Raises BadInputError
        for a photo without a camera or a pixel outside of it."""
        entry = find_entry(self.entries, position.photo, self.what.capitalize())
        width, height = entry["source_width"], entry["source_height"]
        if not (0 <= position.x <= width and 0 <= position.y <= height):
            pixel, pixels = f"{position.x:g},{position.y:g}", f"{width} × {height} pixels"
            raise BadInputError(f"The pixel {pixel} of {self.what} lies outside the photo {position.photo} ({pixels}).")
        camera = self.cameras.get(entry["name"])
        if camera is None:
            raise BadInputError(f"The photo {position.photo} of {self.what} was not registered and has no camera; use another photo.")
        at = np.array([position.x * camera.width / width, position.y * camera.height / height])
        return camera_rays(camera, at + max(camera.width, camera.height) * offsets)


def find_entry(entries: Sequence[Mapping[str, Any]], photo: str, what: str) -> Mapping[str, Any]:
    """The entry of photos.json whose file has this path, file name, or name without suffix. Raises BadInputError, which says `what` names
    the photo."""
    for key in (lambda e: e["source"], lambda e: e["source"].rsplit("/", 1)[-1], lambda e: e["name"]):
        found = [entry for entry in entries if key(entry) == photo]
        if len(found) == 1:
            return found[0]
    names = shortlist([entry["source"] for entry in entries])
    raise BadInputError(f"{what} names the photo '{photo}', which is none of the photos ({names}).")


def triangulate_together(views: Sequence[Sequence[Ray]], noise: float, most: float, least: int) -> tuple[Array, int] | None:
    """The points (k, 3) that the k rays of each view meet, and the number of views that agree: those are left out whose residuals exceed
    `most` pixels. None where fewer than `least` agree, or a point is not determined. `noise` as in `triangulate`."""
    kept = list(views)
    while len(kept) >= least:
        points = [triangulate([view[k] for view in kept], noise) for k in range(len(kept[0]))]
        found = [point for point in points if point is not None]
        if len(found) < len(points):
            return None
        worst = np.max([point.residuals for point in found], axis=0)
        if worst.max() <= most:
            return np.stack([point.position for point in found]), len(kept)
        limit = max(most, 0.5 * float(worst.max()))
        kept = [view for view, residual in zip(kept, worst.tolist(), strict=True) if residual <= limit]
    return None


def triangulate(rays: Sequence[Ray], noise: float = PICK_NOISE) -> Point | None:
    """The point nearest to `rays` in angle, weighted by their pixels; None where their directions differ by less than MIN_ANGLE.

    Distances to the rays are minimised with weights that turn them into angles, which are updated in every step. `noise` is the standard
    deviation of the pixel positions; residuals larger than it raise the covariance.
    """
    directions = np.stack([ray.direction for ray in rays])
    origins = np.stack([ray.origin for ray in rays])
    cosine = np.clip(directions @ directions.T, -1, 1).min()
    if np.degrees(np.arccos(cosine)) < MIN_ANGLE:
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weight = np.ones(len(rays))
    position = np.zeros(3)
    for _ in range(_STEPS):
        normal = np.einsum("n,nij->ij", weight, across)
        position = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weight, across, origins))
        depth = np.maximum(np.linalg.norm(position - origins, axis=1), 1e-12)
        angle = np.array([ray.pixel_angle for ray in rays])
        weight = 1 / (depth * angle) ** 2
    off = np.linalg.norm(np.einsum("nij,nj->ni", across, position - origins), axis=1) / (depth * angle)
    spare = 2 * len(rays) - 3
    variance = max(noise**2, float((off**2).sum()) / spare)
    return Point(position, variance * np.linalg.inv(np.einsum("n,nij->ij", weight, across)), off)
