"""Undistortion of photos to a pinhole camera.

Distortion is OpenCV's rational model: radial k1, k2, k3 over k4, k5, k6 and tangential p1, p2
(https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html). The pinhole image is the largest upright rectangle without blank pixels, at the
focal length of the source, so that the resolution is preserved.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.photos.decode import Bytes
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera

#: Rows of a large photo that are resampled at once.
_BLOCK_ROWS = 32


def distort(points: Array, coefficients: tuple[float, ...]) -> Array:
    """Distorted image plane coordinates of undistorted ones (..., 2) at z = 1; `coefficients` are k1, k2, p1, p2[, k3[, k4, k5, k6]]."""
    return np.stack(_distort(points[..., 0], points[..., 1], coefficients), -1)


def _distort(x: NDArray[Any], y: NDArray[Any], coefficients: tuple[float, ...]) -> tuple[NDArray[Any], NDArray[Any]]:
    """`distort` of x and y, in their precision."""
    k1, k2, p1, p2, k3, k4, k5, k6 = map(float, (*coefficients, *([0.0] * (8 - len(coefficients)))))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if k4 or k5 or k6:
        radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    if not (p1 or p2):
        return x * radial, y * radial
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def undistort_points(points: Array, coefficients: tuple[float, ...], steps: int = 50) -> Array:
    """Inverse of `distort` for points (n, 2), by Newton's method with a numeric Jacobian; points that do not converge become NaN."""
    guess = np.array(points, float)
    h = 1e-6
    for _ in range(steps):
        error = distort(guess, coefficients) - points
        if np.nanmax(np.abs(error), initial=0.0) < 1e-12:
            break
        du = (distort(guess + (h, 0), coefficients) - distort(guess - (h, 0), coefficients)) / (2 * h)
        dv = (distort(guess + (0, h), coefficients) - distort(guess - (0, h), coefficients)) / (2 * h)
        det = du[:, 0] * dv[:, 1] - dv[:, 0] * du[:, 1]
        det = np.where(np.abs(det) < 1e-9, np.nan, det)
        step_x = (dv[:, 1] * error[:, 0] - dv[:, 0] * error[:, 1]) / det
        step_y = (du[:, 0] * error[:, 1] - du[:, 1] * error[:, 0]) / det
        guess = guess - np.stack([step_x, step_y], 1)
    off = np.abs(distort(guess, coefficients) - points).max(1)
    return np.where((off < 1e-6)[:, None], guess, np.nan)


def image_plane(camera: Camera, pixels: Array) -> Array:
    """Undistorted image plane coordinates (n, 2) at z = 1 of `pixels` (n, 2) of the photo; NaN where the distortion has no inverse."""
    plane = (np.asarray(pixels, np.float64) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return undistort_points(plane, camera.distortion) if any(camera.distortion) else plane


def pinhole_camera(camera: Camera) -> Camera:
    """The pinhole camera of the same pose and focal lengths whose pixels the distorted photo all covers.

    Raises BadInputError when the distortion is not invertible inside the photo.
    """
    if not any(camera.distortion):
        return replace(camera, distortion=())
    w, h, n = camera.width, camera.height, 64
    t = np.linspace(0, 1, n)
    sides = {
        "left": np.stack([np.zeros(n), t * h], 1),
        "right": np.stack([np.full(n, w), t * h], 1),
        "top": np.stack([t * w, np.zeros(n)], 1),
        "bottom": np.stack([t * w, np.full(n, h)], 1),
    }
    plane = {k: undistort_points((v - (camera.cx, camera.cy)) / (camera.fx, camera.fy), camera.distortion) for k, v in sides.items()}
    x0, x1 = plane["left"][:, 0].max(), plane["right"][:, 0].min()
    y0, y1 = plane["top"][:, 1].max(), plane["bottom"][:, 1].min()
    bounds = np.array([x0 * camera.fx, x1 * camera.fx, y0 * camera.fy, y1 * camera.fy])
    width, height = np.floor(bounds[1] - bounds[0] + 1e-6), np.floor(bounds[3] - bounds[2] + 1e-6)
    if not np.isfinite(bounds).all() or not (0.25 * w < width < 4 * w and 0.25 * h < height < 4 * h):
        raise BadInputError(f"The lens distortion {camera.distortion} of photo {camera.name} cannot be inverted; check the calibration.")
    return replace(camera, width=int(width), height=int(height), cx=float(-bounds[0]), cy=float(-bounds[2]), distortion=())


def remap_tables(source: Camera, target: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (h, w) x and y in the photo of `source` of each pixel of the pinhole `target`, in OpenCV's pixels (centres at integers).

    In single precision: to a few thousandths of a pixel, where OpenCV interpolates to 1/32.
    """
    x = ((np.arange(target.width) + 0.5 - target.cx) / target.fx).astype(np.float32)
    y = ((np.arange(target.height) + 0.5 - target.cy) / target.fy).astype(np.float32)
    columns, rows = np.broadcast_arrays(x, y[:, None])
    u, v = _distort(columns, rows, source.distortion)
    return u * np.float32(source.fx) + np.float32(source.cx - 0.5), v * np.float32(source.fy) + np.float32(source.cy - 0.5)


def resample(image: Bytes, tables: tuple[NDArray[np.float32], NDArray[np.float32]], mask: bool = False) -> Bytes:
    """The photo (h, w, 3) resampled through `remap_tables` with a cubic kernel; masks (h, w) linearly, to avoid ringing."""
    kernel = cv2.INTER_LINEAR if mask else cv2.INTER_CUBIC
    return np.asarray(cv2.remap(image, tables[0], tables[1], kernel, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def undistorted(image: Bytes, source: Camera, target: Camera, mask: bool = False) -> Bytes:
    """The photo (h, w, 3) or mask (h, w) of `source` as the pinhole `target` shows it; tables are made for a few rows at a time."""
    blocks = []
    for start in range(0, target.height, _BLOCK_ROWS):
        rows = replace(target, height=min(_BLOCK_ROWS, target.height - start), cy=target.cy - start)
        blocks.append(resample(image, remap_tables(source, rows), mask))
    return np.concatenate(blocks)


def intrinsics_key(camera: Camera) -> tuple[float, ...]:
    """Intrinsics as a key: cameras with equal keys share one set of `remap_tables`."""
    return (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
