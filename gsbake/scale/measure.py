"""The metric scale of a capture, from printed markers and known distances, else from GPS positions, with its uncertainty."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsbake.config.lengths import KnownDistance, PixelPosition, parse_known_distance
from gsbake.config.schema import Scale
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from gsbake.geometry.raycast import RayCaster
from gsbake.monitor import SILENT, Monitor
from gsbake.scale.gps import MAX_ERROR, gps_scale
from gsbake.scale.markers import find_markers
from gsbake.scale.triangulation import PICK_NOISE, PickedPhotos, Point, triangulate

#: Difference between measurements that is reported, as a share and in standard deviations.
MAX_DISAGREEMENT, MAX_DEVIATION = 0.05, 4.0


@dataclass(frozen=True)
class MetricScale:
    """Metres per unit of the world, relative standard deviation, and what it was measured by."""

    metres: float
    relative_error: float
    evidence: str


@dataclass(frozen=True)
class _Measurement:
    """One length: metres per unit of the world, relative standard deviation, and its name."""

    metres: float
    relative_error: float
    name: str


def measure_scale(
    ingest: Path, poses: Path, options: Scale, surface: RayCaster | None = None, to_world: Similarity | None = None, *,
    monitor: Monitor = SILENT,
) -> MetricScale | None:  # fmt: skip
    """The scale of the posed photos in the artifact folders `ingest` and `poses`; None where nothing tells it.

    A point that one photo names lies on `surface`, whose frame `to_world` maps to the world. Raises BadInputError for points that cannot
    be determined.
    """
    if not options.known_distances and not options.marker_size:
        return _measure_gps(ingest, poses, monitor) if options.gps else None
    cameras = CameraSet.load(poses / "photo_cameras.json").cameras
    found = []
    if options.marker_size:
        found += _measure_markers(cameras, ingest, options, monitor)
    if options.known_distances:
        picked = PickedPhotos.open(ingest, poses, "a known distance")
        for text in options.known_distances:
            found.append(_measure_distance(parse_known_distance(text), picked, surface, to_world or Similarity()))
    if not found:
        return None
    scale = _reported(_combine(found), monitor)
    for item in found:
        off = abs(item.metres / scale.metres - 1)
        if off > max(MAX_DISAGREEMENT, MAX_DEVIATION * item.relative_error):
            monitor.warn(f"The scale by {item.name} differs by {100 * off:.0f} % from that by all; check its points and its length.")
    return scale


def _measure_gps(ingest: Path, poses: Path, monitor: Monitor) -> MetricScale | None:
    """The scale of solved poses by the positions in EXIF, where it is known well enough; reports why not."""
    entries = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
    positions = {entry["name"]: entry["gps"] for entry in entries if entry.get("gps")}
    if not positions or not (poses / "photo_cameras.json").exists():  # cameras that the user put in their place have none
        return None
    posed = CameraSet.load(poses / "photo_cameras.json")
    found = gps_scale(posed.cameras, positions) if posed.poses == "solved" else None
    if found is None:
        return None
    evidence = f"GPS positions of {found.photos} photos"
    if found.relative_error > MAX_ERROR:
        monitor.decide("scale", "unknown", f"{evidence} tell it to {found.relative_error:.0%}, not to {MAX_ERROR:.0%}")
        return None
    return _reported(MetricScale(found.metres, found.relative_error, evidence), monitor)


def _reported(scale: MetricScale, monitor: Monitor) -> MetricScale:
    """The scale itself, after a report of it."""
    monitor.decide("scale", f"{scale.metres:.5g} metres per unit ± {100 * scale.relative_error:.2g} %", scale.evidence)
    return scale


def _measure_markers(cameras: Sequence[Camera], ingest: Path, options: Scale, monitor: Monitor) -> list[_Measurement]:
    """One measurement per marker."""
    dictionary, markers = find_markers(cameras, ingest / "photos", options.marker_dictionary)
    if not markers:
        monitor.warn("No printed marker is seen in three photos or more; the scale of the asset stays unknown.")
    found = []
    for marker in markers:
        side = float(marker.sides.mean())
        spread = float(np.std(marker.sides, ddof=1)) / side / 2  # of the mean of four
        name = f"marker {marker.number} ({dictionary}, {marker.photos} photos)"
        found.append(_Measurement(options.marker_size / side, max(spread, 1e-4), name))
    return found


def _measure_distance(distance: KnownDistance, photos: PickedPhotos, surface: RayCaster | None, to_world: Similarity) -> _Measurement:
    """The measurement by one known distance."""
    first, second = (_locate(views, distance.text, photos, surface, to_world) for views in (distance.first, distance.second))
    between = first.position - second.position
    length = float(np.linalg.norm(between))
    if length < 1e-12:
        raise BadInputError(f"The two points of the known distance '{distance.text}' are the same point.")
    along = between / length
    deviation = float(np.sqrt(along @ (first.covariance + second.covariance) @ along))
    return _Measurement(distance.metres / length, max(deviation / length, 1e-4), f"the known distance '{distance.text}'")


def _locate(views: Sequence[PixelPosition], text: str, photos: PickedPhotos, surface: RayCaster | None, to_world: Similarity) -> Point:
    """A point in the world: triangulated, or where the only ray meets the surface. Raises BadInputError where there is none."""
    rays = [photos.ray(view) for view in views]
    names = " and ".join(view.photo for view in views)
    if len(rays) > 1:
        point = triangulate(rays)
        if point is None:
            raise BadInputError(f"{names} show a point of the known distance '{text}' from nearly the same direction; add another photo.")
        return point
    origin = to_world.inverse().apply(rays[0].origin)
    direction = rays[0].direction @ to_world.rotation
    hits = None if surface is None else surface.first_hit(origin[None], direction[None])
    if hits is None or not hits.hit[0]:
        raise BadInputError(
            f"A point of the known distance '{text}' is not on the object in {names}; give it in a second photo too, as in "
            "A.jpg:120,80+C.jpg:131,77."
        )
    depth = float(hits.distance[0]) * to_world.scale
    position = rays[0].origin + depth * rays[0].direction
    return Point(position, np.eye(3) * 2 * (PICK_NOISE * depth * rays[0].pixel_angle) ** 2, np.zeros(1))


def _combine(found: Sequence[_Measurement]) -> MetricScale:
    """The mean of the measurements, weighted by their variances; its error is at least what their spread shows."""
    value = np.array([item.metres for item in found])
    weight = np.array([(item.metres * item.relative_error) ** -2 for item in found])
    mean = float((weight * value).sum() / weight.sum())
    error = float(weight.sum()) ** -0.5
    if len(found) > 1:
        spread = float((weight * (value - mean) ** 2).sum() / weight.sum() / (len(found) - 1)) ** 0.5
        error = max(error, spread)
    names = ", ".join(item.name for item in found[:4]) + (f" and {len(found) - 4} more" if len(found) > 4 else "")
    return MetricScale(mean, error / mean, names)
