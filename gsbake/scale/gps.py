"""The metric scale by satellite navigation: cameras against the positions in EXIF.

A receiver is off by metres, so that a capture of a small object says nothing; photos taken over tens of metres, as by a drone, give the
scale to a few percent. The similarity is the least-squares one (Umeyama, *Least-squares estimation of transformation parameters between
two point patterns*, PAMI 1991), and its residuals give the error of the scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsbake.geometry.cameras import Array, Camera

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
    b = local_metres(np.array([positions[camera.name] for camera in known], float))
    a, b = centres - centres.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    spread = float((a * a).sum())
    if spread <= 1e-12 * max(1.0, float((centres * centres).sum())) or not (metres := float((s * sign).sum()) / spread) > 0:
        return None
    residual = b - metres * a @ (u @ np.diag(sign) @ vt).T
    deviation = float(np.sqrt((residual**2).sum() / (3 * len(known) - 7)))
    return GpsScale(metres, max(deviation / (metres * spread**0.5), 1e-4), len(known))
