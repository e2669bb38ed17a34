"""The metric scale by satellite navigation: cameras against the positions in EXIF.

A receiver is off by metres, so that a capture of a small object says nothing; photos taken over tens of metres, as by a drone, give the
scale to a few percent. The residuals of the least-squares similarity give the error of its scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsbake.geometry.cameras import Array, Camera, Similarity

#: Fewest photos with a position, and largest relative standard deviation of a scale that is used.
MIN_PHOTOS, MAX_ERROR = 6, 0.05
#: Semi-major axis in metres and squared eccentricity of the WGS 84 ellipsoid.
_AXIS, _ECCENTRICITY = 6378137.0, 6.69437999014e-3


@dataclass(frozen=True)
class GpsScale:
    """Metres per unit of the cameras' frame, its relative standard deviation, and the number of photos."""

    metres: float
    relative_error: float
    photos: int


def local_metres(positions: Array) -> Array:
    """Positions (n, 3), latitude and longitude in degrees and altitude in metres, in metres East, North and up of the first."""
    latitude, longitude = np.radians(positions[:, 0]), np.radians(positions[:, 1])
    root = 1 - _ECCENTRICITY * np.sin(latitude[0]) ** 2
    meridian, transverse = _AXIS * (1 - _ECCENTRICITY) / root**1.5, _AXIS / root**0.5  # radii of curvature
    turn = (longitude - longitude[0] + np.pi) % (2 * np.pi) - np.pi  # also across the date line
    east, north = transverse * np.cos(latitude[0]) * turn, meridian * (latitude - latitude[0])
    return np.column_stack([east, north, positions[:, 2] - positions[0, 2]])


def gps_scale(cameras: Sequence[Camera], positions: Mapping[str, Sequence[float]]) -> GpsScale | None:
    """The scale of cameras by the `positions` (latitude, longitude, altitude) of some of them by name; None with too few photos, or where
    cameras or positions do not differ."""
    known = [camera for camera in cameras if camera.name in positions]
    if len(known) < MIN_PHOTOS:
        return None
    centres = np.stack([camera.centre for camera in known])
    spread = float(np.linalg.norm(centres - centres.mean(0)))
    if spread <= 1e-6 * max(1.0, float(np.linalg.norm(centres))):
        return None
    metres = local_metres(np.array([positions[camera.name] for camera in known], float))
    fitted = Similarity.between(centres, metres)
    if not fitted.scale > 0:
        return None
    deviation = float(np.linalg.norm(fitted.apply(centres) - metres)) / (3 * len(known) - 7) ** 0.5
    return GpsScale(fitted.scale, max(deviation / (fitted.scale * spread), 1e-4), len(known))
