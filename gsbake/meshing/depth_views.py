"""Depth maps for fusion: inverse depth, weight, cosine of incidence and distance outside the mask per pixel.

Depth rendered from surfels is unreliable at low alpha, at depth discontinuities (it mixes a near and a far layer) and at grazing
incidence. `DepthView.from_gbuffer` rejects or down-weights such pixels; it does not smooth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.imaging.distance import distance_to_zero
from gsbake.kernels.declaration import kernel

Floats = NDArray[np.float32]

#: Minimum alpha of a rendered depth.
MIN_ALPHA = 0.5
#: Minimum cosine between normal and ray: the depth error along the ray grows with 1/cosine.
MIN_COSINE = 0.1
#: Uncertainty of a mask's boundary in pixels.
MASK_MARGIN = 0.75


@dataclass(frozen=True)
class DepthView:
    """One view for fusion; all maps (h, w) float32.

    `inverse` is 1/z-depth (0 = none), `weight` ≥ 0, `cosine` in (0, 1] between normal and ray (1 where unknown),
    `mask_distance` the distance in pixels outside the mask minus `MASK_MARGIN` (0 inside, and everywhere without a mask).
    """

    camera: Camera
    inverse: Floats
    weight: Floats
    cosine: Floats
    mask_distance: Floats

    @staticmethod
    def from_depth(
        camera: Camera,
        depth: Floats,
        weight: Floats | None = None,
        cosine: Floats | None = None,
        mask: NDArray[np.uint8] | None = None,
        margin: float = MASK_MARGIN,
    ) -> DepthView:
        """From a z-depth map (h, w; 0 or not finite = none); `mask` is 8-bit, 255 = object. Raises ValueError for a wrong shape."""
        shape = (camera.height, camera.width)
        if depth.shape != shape:
            raise ValueError(f"depth map has shape {depth.shape}, the camera {shape}")
        valid_depth = np.isfinite(depth) & (depth > 0)
        inverse = np.where(valid_depth, 1 / np.where(valid_depth, depth, 1), 0)
        return DepthView(
            camera,
            np.ascontiguousarray(inverse, np.float32),
            np.ones(shape, np.float32) if weight is None else np.ascontiguousarray(weight, np.float32),
            np.ones(shape, np.float32) if cosine is None else np.ascontiguousarray(cosine, np.float32),
            np.zeros(shape, np.float32) if mask is None else distance_outside_mask(mask, margin),
        )

    @staticmethod
    def from_gbuffer(camera: Camera, buffers: Mapping[str, Any], mask: NDArray[np.uint8] | None, tolerance: float) -> DepthView:
        """From rendered "depth", "median_depth", "normal", "alpha"; `tolerance` (world units) is the minimum distance of two layers.

        The expected depth is used where it agrees with the median depth to a quarter of `tolerance`, the median elsewhere (the expected
        depth lies between two layers there).
        Weight: alpha × cosine × 1/z² (the footprint of a far pixel is larger), relative to the median depth.
        """
        alpha = np.asarray(buffers["alpha"], np.float32).reshape(camera.height, camera.width)
        expected = np.asarray(buffers["depth"], np.float32).reshape(alpha.shape)
        median = np.asarray(buffers["median_depth"], np.float32).reshape(alpha.shape)
        depth = np.where(np.abs(expected - median) < tolerance / 4, expected, median)
        cosine = _cosine(camera, np.asarray(buffers["normal"], np.float32))
        valid_depth = (alpha > MIN_ALPHA) & np.isfinite(alpha) & np.isfinite(depth) & (depth > 0) & (cosine > MIN_COSINE)
        depth = np.where(valid_depth, depth, 0).astype(np.float32)
        consistent = _has_consistent_neighbours(depth, np.maximum(cosine, MIN_COSINE), np.float32(tolerance), np.float32(1 / camera.fx))
        depth = np.where(consistent, depth, 0)
        reference_depth = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
        weight = alpha * cosine * (reference_depth / np.maximum(depth, 1e-6)) ** 2
        return DepthView.from_depth(camera, depth, np.where(depth > 0, weight, 0).astype(np.float32), np.maximum(cosine, MIN_COSINE), mask)


def distance_outside_mask(mask: NDArray[np.uint8], margin: float = MASK_MARGIN) -> Floats:
    """Distance in pixels (h, w) of pixel centres outside the mask (< 128) from its boundary, minus `margin`, at least 0."""
    inside = (mask >= 128).astype(np.uint8)
    if not inside.any():
        return np.full(mask.shape, float(max(mask.shape)), np.float32)
    if inside.all():
        return np.zeros(mask.shape, np.float32)
    # The boundary lies half a pixel before the centre of the nearest inside pixel.
    distance = distance_to_zero(1 - inside) - 0.5
    return np.maximum(distance - margin, 0).astype(np.float32)


def depth_noise(first: DepthView, second: DepthView, stride: int = 4) -> float | None:
    """Median difference (world units, along the ray) of two views' depths of the same points; None below 50 shared points.

    Points of `first` are projected into `second`; differences above 10 % of the depth are occlusion and ignored.
    """
    v, u = np.mgrid[0 : first.camera.height : stride, 0 : first.camera.width : stride]
    inverse = first.inverse[v, u].ravel()
    keep = (inverse > 0) & (first.mask_distance[v, u].ravel() == 0)
    if keep.sum() < 50:
        return None
    z = 1 / inverse[keep].astype(np.float64)
    camera = first.camera
    local = np.stack([(u.ravel()[keep] + 0.5 - camera.cx) / camera.fx * z, (v.ravel()[keep] + 0.5 - camera.cy) / camera.fy * z, z], 1)
    pixels, depth = second.camera.project((local - camera.t) @ camera.R)
    column, row = np.floor(pixels).astype(int).T
    valid = (depth > 0) & (column >= 0) & (row >= 0) & (column < second.camera.width) & (row < second.camera.height)
    second_inverse = np.zeros(len(depth))
    second_inverse[valid] = second.inverse[row[valid], column[valid]]
    valid &= second_inverse > 0
    difference = np.abs(depth[valid] - 1 / second_inverse[valid])
    difference = difference[difference < 0.1 * depth[valid]]
    return float(np.median(difference)) if len(difference) >= 50 else None


def _cosine(camera: Camera, normal: Floats) -> Floats:
    """|cos| between the normals (h, w, 3) and the pixels' rays; 0 where the normal is missing."""
    rays = camera.rays()
    length = np.linalg.norm(normal, axis=-1)
    with np.errstate(invalid="ignore"):
        value = np.abs((normal * rays).sum(-1)) / np.maximum(length * np.linalg.norm(rays, axis=-1), 1e-12)
        return np.where((length > 0.5) & np.isfinite(value), value, 0).astype(np.float32)


@kernel("f4[:, ::1], f4[:, ::1], f4, f4")
def _has_consistent_neighbours(depth: Any, cosine: Any, tolerance: Any, pixel: Any) -> Any:
    """Whether at least two of the eight neighbours lie on the same layer: within `tolerance` / 2 plus the slope's depth change."""
    height, width = depth.shape
    out = np.zeros(depth.shape, np.bool_)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if z <= 0:
                continue
            c = cosine[v, u]
            allowed = 0.5 * tolerance + 2 * pixel * z * np.sqrt(max(0.0, 1 - c * c)) / c
            consistent = 0
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    y, x = v + dv, u + du
                    if (dv != 0 or du != 0) and y >= 0 and x >= 0 and y < height and x < width and depth[y, x] > 0:
                        consistent += abs(depth[y, x] - z) < allowed
            out[v, u] = consistent >= 2
    return out
