"""Filtered depth maps: geometrically consistent, without speckles, inside the visual hull."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.consistency import Consistency

Floats = NDArray[np.float32]

#: Pixels with a matching cost (mean 1 − NCC) of this or more are discarded before the consistency check.
MAX_COST = 0.6
#: Largest ratio of free-space violations to consistent views.
MAX_VIOLATION_SHARE = 0.34
#: Number of consistent views at which confidence saturates.
FULL_CONFIDENCE_VIEWS = 5
#: Scatter of the consistent depths (share of the depth) at which confidence halves.
SCATTER_SCALE = 0.003
#: Segments smaller than this share of the squared longer side are speckles; depths of neighbouring pixels in a segment differ by less than
#: the second (relative).
MIN_SEGMENT_SHARE, MAX_DEPTH_STEP = 2.5e-4, 0.01
#: Points farther outside the hull than this many cells are removed.
HULL_MARGIN = 1.5


#: Bits behind the leading one of a depth on disk, and steps of a confidence.
_DEPTH_BITS, _CONFIDENCE_STEPS = 14, 256


@dataclass(frozen=True)
class DepthMap:
    """One photo's depth map, as a list of its pixels with a depth, as most have none: `camera`, `pixels` (n,), the flat indices in
    ascending order, `plane` (n, 3), `confidence` (n,) in 0..1, consistent `views` (n,)."""

    camera: Camera
    pixels: NDArray[np.int64]
    plane: Floats
    confidence: Floats
    views: NDArray[np.uint8]

    @staticmethod
    def of(camera: Camera, plane: Floats, confidence: Floats, views: NDArray[np.uint8]) -> DepthMap:
        """The depth map of images: `plane` (h, w, 3), `confidence` (h, w), 0 = no depth, `views` (h, w)."""
        pixels = np.flatnonzero(z_depth(camera, plane, confidence > 0))
        return DepthMap(camera, pixels, plane.reshape(-1, 3)[pixels], confidence.ravel()[pixels], views.ravel()[pixels])

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, keep: NDArray[np.bool_]) -> DepthMap:
        """The pixels in `keep` (n,)."""
        return DepthMap(self.camera, self.pixels[keep], self.plane[keep], self.confidence[keep], self.views[keep])

    def depth(self) -> Floats:
        """z-depth (h, w), 0 = none."""
        return self._image(self._z())

    def camera_points(self) -> Array:
        """Points (n, 3) of the pixels in the frame of the camera."""
        camera, z = self.camera, self._z().astype(np.float64)
        row, column = np.divmod(self.pixels, camera.width)
        return np.stack([(column + 0.5 - camera.cx) / camera.fx * z, (row + 0.5 - camera.cy) / camera.fy * z, z], 1)

    def _z(self) -> Floats:
        row, column = np.divmod(self.pixels, self.camera.width)
        x = ((column + 0.5 - self.camera.cx) / self.camera.fx).astype(np.float32)
        y = ((row + 0.5 - self.camera.cy) / self.camera.fy).astype(np.float32)
        return np.asarray(1 / (self.plane[:, 0] * x + self.plane[:, 1] * y + self.plane[:, 2]), np.float32)

    def _image(self, values: Floats) -> Floats:
        image = np.zeros((self.camera.height, self.camera.width), np.float32)
        image.ravel()[self.pixels] = values
        return image

    def save(self, path: Path) -> None:
        """Write depth and confidence as a NumPy archive, compressed at the fastest level: most pixels of a masked photo have no depth.

        Both are rounded to what matching determines, a depth to 3e-5 of itself: nearly half of the bytes would be noise.
        """
        confidence = np.asarray(np.maximum(np.rint(_CONFIDENCE_STEPS * self.confidence), 1) / _CONFIDENCE_STEPS, np.float32)
        images: dict[str, NDArray[Any]] = {"depth": rounded(self.depth()), "confidence": self._image(confidence).astype(np.float16)}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, values in images.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, values, allow_pickle=False)


def rounded(values: Floats) -> Floats:
    """The values with _DEPTH_BITS bits behind the leading one, rounded to nearest."""
    mantissa, exponent = np.frexp(values)
    steps = np.float32(2 ** (_DEPTH_BITS + 1))
    return np.ldexp(np.rint(mantissa * steps) / steps, exponent).astype(np.float32)


def read_depth(path: Path) -> tuple[Floats, Floats]:
    """z-depth (h, w; 0 = none) and confidence (h, w) in 0..1 that `DepthMap.save` wrote."""
    with np.load(path) as body:
        return body["depth"], body["confidence"].astype(np.float32)


def inverse_depth(camera: Camera, plane: Floats) -> Floats:
    """1/z (h, w) at the pixel centres of planes (h, w, 3)."""
    x = ((np.arange(camera.width) + 0.5 - camera.cx) / camera.fx).astype(np.float32)
    y = ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy).astype(np.float32)
    return np.asarray(plane[..., 0] * x[None, :] + plane[..., 1] * y[:, None] + plane[..., 2], np.float32)


def z_depth(camera: Camera, plane: Floats, keep: NDArray[np.bool_]) -> Floats:
    """z-depth (h, w) of planes (h, w, 3) where `keep` (h, w) holds and they lie in front of the camera, 0 elsewhere."""
    rho = inverse_depth(camera, plane)
    valid = keep & (rho > 0)
    return np.where(valid, 1 / np.where(valid, rho, 1), 0).astype(np.float32)


def matched_pixels(cost: Floats) -> NDArray[np.uint8]:
    """Pixels (h, w) that matched: 1 where the cost (h, w) is low enough."""
    return (cost < MAX_COST).astype(np.uint8)


def consistent_pixels(found: Consistency, min_views: int) -> NDArray[np.uint8]:
    """Pixels (h, w) with at least `min_views` consistent views and few free-space violations."""
    return ((found.consistent >= min_views) & (found.violations <= MAX_VIOLATION_SHARE * found.consistent)).astype(np.uint8)


def filter_depth_map(camera: Camera, cost: Floats, found: Consistency, min_views: int, hull: Hull | None) -> DepthMap:
    """The depth map of one photo from its final consistency check and matching costs (h, w)."""
    keep = consistent_pixels(found, min_views) > 0
    rho = np.where(keep, inverse_depth(camera, found.plane), 0)
    keep &= rho > 0
    if hull is not None and keep.any():
        v, u = np.nonzero(keep)
        z = 1 / rho[v, u].astype(np.float64)
        local = np.stack([(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], 1)
        keep[v, u] = hull.signed_distance((local - camera.t) @ camera.R) < HULL_MARGIN * hull.cell
    keep &= _without_speckles(rho, keep)
    views = np.where(keep, found.consistent, 0).astype(np.uint8)
    agreement = np.minimum(found.consistent / FULL_CONFIDENCE_VIEWS, 1)
    confidence = agreement * np.clip(1 - cost, 0, 1) / (1 + (found.scatter / SCATTER_SCALE) ** 2)
    return DepthMap.of(camera, found.plane, np.where(keep, np.maximum(confidence, 1e-3), 0).astype(np.float32), views)


def _without_speckles(rho: Floats, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`keep` (h, w) without small segments of continuous inverse depth `rho` (h, w)."""
    if not keep.any():
        return keep
    # The filter takes integers; in the logarithm of the depth MAX_DEPTH_STEP is the same difference everywhere.
    steps = np.log(np.where(keep, rho, 1)) / MAX_DEPTH_STEP * 100
    steps -= steps[keep].min() - 100
    image = np.where(keep, np.minimum(steps, 32000), 0).astype(np.int16)
    min_pixels = max(6, round(MIN_SEGMENT_SHARE * max(rho.shape) ** 2))
    return np.asarray(cv2.filterSpeckles(image, 0, min_pixels, 100)[0] > 0)
