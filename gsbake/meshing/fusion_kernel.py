"""Numba kernel of TSDF fusion: integrates one depth view into the samples of many blocks.

Curless & Levoy, *A volumetric method for building complex models from range images*, SIGGRAPH 1996, with three changes:
distances are measured to the tangent plane where the view's normals are known (Bylow et al. 2013), the weight falls off behind the
surface so that thin parts keep both sides, and pixels outside the mask count as free space (the visual hull).

Single precision, without the interpreter lock. Each sample is written by one thread and takes the views in order, so the result does not
depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from gsbake.geometry.sparse_lattice import EDGE
from gsbake.kernels.declaration import kernel

#: Bits of `observed`: the sample lies in front of or near a measured depth; the sample projects outside a mask.
OBSERVED_BY_DEPTH, OBSERVED_BY_MASK = 1, 2

#: Relation of a block to a view: inside its depth range, outside the image or without depth, behind all depths.
BLOCK_VISIBLE, BLOCK_UNOBSERVED, BLOCK_OCCLUDED = 0, 1, 2
#: Edge of the tiles that store a view's maximum depth, in pixels.
TILE = 8


@kernel("f4[:, ::1], f4[:, ::1], f4", nogil=True)
def max_depth_tiles(inverse_depth: Any, mask_distance: Any, truncation: Any) -> Any:
    """Maximum z-depth that each tile of 8 x 8 pixels affects: -1 = no depth, inf = the tile has pixels outside the mask."""
    height, width = inverse_depth.shape
    out = np.full((-(-height // TILE), -(-width // TILE)), np.float32(-1))
    for v in range(height):
        for u in range(width):
            if mask_distance[v, u] > 0:
                out[v // TILE, u // TILE] = np.inf
            elif inverse_depth[v, u] > 0:
                # One truncation distance behind the surface and one for interpolation between pixels.
                farthest = np.float32(1) / inverse_depth[v, u] + np.float32(2) * truncation
                out[v // TILE, u // TILE] = max(out[v // TILE, u // TILE], farthest)
    return out


@nb.njit(cache=True, nogil=True, forceinline=True)
def _classify_block(
    x0: Any,
    y0: Any,
    z0: Any,
    cell: Any,
    rotation: Any,
    translation: Any,
    fx: Any,
    fy: Any,
    cx: Any,
    cy: Any,
    width: int,
    height: int,
    max_depth: Any,
) -> Any:
    """Relation of the block with first sample (x0, y0, z0) to a view: BLOCK_VISIBLE, BLOCK_UNOBSERVED or BLOCK_OCCLUDED."""
    half = np.float32((EDGE - 1) / 2) * cell
    x, y, z = x0 + half, y0 + half, z0 + half
    px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
    py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
    pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    radius = np.float32(1.7320508) * half
    if pz + radius <= 0:
        return BLOCK_UNOBSERVED
    if pz <= np.float32(1.5) * radius:
        return BLOCK_VISIBLE
    rx, ry = px / pz, py / pz
    angular_radius = radius / (pz - radius)
    du, dv = fx * angular_radius * np.sqrt(1 + rx * rx), fy * angular_radius * np.sqrt(1 + ry * ry)
    u, v = fx * rx + cx, fy * ry + cy
    if u + du < 0 or v + dv < 0 or u - du >= width or v - dv >= height:
        return BLOCK_UNOBSERVED
    farthest = np.float32(-1)
    for row in range(max(0, int(v - dv) // TILE), min(max_depth.shape[0] - 1, int(v + dv) // TILE) + 1):
        for col in range(max(0, int(u - du) // TILE), min(max_depth.shape[1] - 1, int(u + du) // TILE) + 1):
            farthest = max(farthest, max_depth[row, col])
    if farthest < 0:
        return BLOCK_UNOBSERVED
    return BLOCK_OCCLUDED if pz - radius > farthest else BLOCK_VISIBLE


@kernel(
    "i8, i8, i4[:, ::1], f4[::1], f4, f4, f4[:, ::1], f4[::1], f4[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4, "
    "f4, f4[:, :, :, ::1], f4[:, :, :, ::1], u1[:, :, :, ::1], u2[:, :, :, ::1], i4[::1]",
    nogil=True, error_model="numpy",
)
def fuse_view(
    start: int,
    stop: int,
    coords: Any,
    lower: Any,
    cell: Any,
    truncation: Any,
    rotation: Any,
    translation: Any,
    intrinsics: Any,
    inverse_depth: Any,
    weight: Any,
    cosine: Any,
    mask_distance: Any,
    max_depth: Any,
    mask_weight: Any,
    free_space_weight: Any,
    values: Any,
    weights: Any,
    observed: Any,
    occluded: Any,
    occluded_blocks: Any,
) -> None:
    """Integrate one view into blocks start..stop: running means `values` (n, 8, 8, 8), their `weights` and the bits `observed`.

    `occluded` and, for whole blocks, `occluded_blocks` (n,) count the views whose surface lies in front of the sample.

    `inverse_depth` (h, w) holds 1/z, 0 = none; `cosine` (h, w) the cosine between normal and ray; `mask_distance` (h, w) the distance
    in pixels outside the mask (0 inside); `max_depth` is `max_depth_tiles` of the view; `intrinsics` is (fx, fy, cx, cy),
    pixel centres at +.5.
    """
    height, width = inverse_depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half = np.float32(0.5)
    one = np.float32(1.0)
    for n in range(start, stop):
        x0 = np.float32(lower[0] + cell * coords[n, 0] * EDGE)
        y0 = np.float32(lower[1] + cell * coords[n, 1] * EDGE)
        z0 = np.float32(lower[2] + cell * coords[n, 2] * EDGE)
        block_class = _classify_block(x0, y0, z0, cell, rotation, translation, fx, fy, cx, cy, width, height, max_depth)
        if block_class == BLOCK_OCCLUDED:
            occluded_blocks[n] += 1
        if block_class != BLOCK_VISIBLE:
            continue
        for i in range(EDGE):
            px = x0 + np.float32(i) * cell
            for j in range(EDGE):
                py = y0 + np.float32(j) * cell
                ax = rotation[0, 0] * px + rotation[0, 1] * py + translation[0]
                ay = rotation[1, 0] * px + rotation[1, 1] * py + translation[1]
                az = rotation[2, 0] * px + rotation[2, 1] * py + translation[2]
                for k in range(EDGE):
                    pz = z0 + np.float32(k) * cell
                    z = az + rotation[2, 2] * pz
                    if z < np.float32(1e-4):
                        continue
                    rx = (ax + rotation[0, 2] * pz) / z
                    ry = (ay + rotation[1, 2] * pz) / z
                    u = fx * rx + cx
                    v = fy * ry + cy
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    iu, iv = int(u), int(v)
                    ray_length = np.sqrt(one + rx * rx + ry * ry)
                    pixels_outside = mask_distance[iv, iu]
                    if pixels_outside > 0:
                        bound = min(one, pixels_outside * z / (fx * truncation))
                        total = weights[n, i, j, k] + mask_weight
                        values[n, i, j, k] += (bound - values[n, i, j, k]) * mask_weight / total
                        weights[n, i, j, k] = total
                        observed[n, i, j, k] |= OBSERVED_BY_MASK
                        continue
                    # Planes are linear in 1/z: interpolate that, unless the four pixels span a depth discontinuity.
                    s, t = u - half, v - half
                    iu0, iv0 = int(np.floor(s)), int(np.floor(t))
                    inverse = inverse_depth[iv, iu]
                    if iu0 >= 0 and iv0 >= 0 and iu0 + 1 < width and iv0 + 1 < height:
                        a, b = inverse_depth[iv0, iu0], inverse_depth[iv0, iu0 + 1]
                        c, d = inverse_depth[iv0 + 1, iu0], inverse_depth[iv0 + 1, iu0 + 1]
                        low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
                        if low > 0 and (high - low) < truncation * low * high:
                            fu, fv = s - iu0, t - iv0
                            inverse = (a * (one - fu) + b * fu) * (one - fv) + (c * (one - fu) + d * fu) * fv
                    sample_weight = weight[iv, iu]
                    if inverse <= 0 or sample_weight <= 0:
                        continue
                    # Behind the surface the distance along the ray decides: a grazing ray soon leaves a convex body, and
                    # a negative value on the far side would inflate the body.
                    ray_distance = (one / inverse - z) * ray_length / truncation
                    if ray_distance < -one:
                        occluded[n, i, j, k] += 1
                        continue
                    distance = ray_distance * cosine[iv, iu]
                    if distance > one:
                        distance = one
                        sample_weight *= free_space_weight
                    elif ray_distance < -np.float32(0.25):
                        sample_weight *= np.float32(4.0 / 3.0) * (one + ray_distance)
                    total = weights[n, i, j, k] + sample_weight
                    if total > 0:
                        values[n, i, j, k] += (distance - values[n, i, j, k]) * sample_weight / total
                        weights[n, i, j, k] = total
                        # Farther behind, "inside" is not observed (wrong below an overhang): left to hole filling.
                        if ray_distance > -half:
                            observed[n, i, j, k] |= OBSERVED_BY_DEPTH


@kernel("f4[:, ::1], f4[:, ::1], f8[::1, :], f8[::1], f8[::1], f8, b1[:, :, ::1]", nogil=True)
def mark_blocks_near_depth(
    inverse_depth: Any, mask_distance: Any, to_lattice: Any, origin: Any, intrinsics: Any, radius: float, marked: Any
) -> None:
    """Mark in `marked` (per block) the blocks within `radius` samples of the points of a depth map.

    `to_lattice` (3, 3) maps camera directions to lattice samples; `origin` (3,) is the camera centre in lattice samples.
    """
    height, width = inverse_depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    lo = np.zeros(3, np.int64)
    hi = np.zeros(3, np.int64)
    for v in range(height):
        for u in range(width):
            if inverse_depth[v, u] <= 0 or mask_distance[v, u] > 0:
                continue
            z = 1.0 / inverse_depth[v, u]
            x = (u + 0.5 - cx) / fx * z
            y = (v + 0.5 - cy) / fy * z
            for a in range(3):
                p = to_lattice[a, 0] * x + to_lattice[a, 1] * y + to_lattice[a, 2] * z + origin[a]
                lo[a] = max(0, int(np.floor((p - radius) / EDGE)))
                hi[a] = min(marked.shape[a] - 1, int(np.floor((p + radius) / EDGE)))
            for a in range(lo[0], hi[0] + 1):
                for b in range(lo[1], hi[1] + 1):
                    for c in range(lo[2], hi[2] + 1):
                        marked[a, b, c] = True
