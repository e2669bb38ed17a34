"""The kernel of depth-map fusion: one view into the samples of many blocks.

Curless & Levoy, *A volumetric method for building complex models from range images*, SIGGRAPH 1996, with three changes:
distances are measured to the tangent plane where the view's normals are known (Bylow et al. 2013), the weight falls off behind the
surface so that both sides of thin things survive, and pixels outside the object's mask vote for emptiness (the visual hull).

Numba, single precision, without the interpreter lock, so that a thread pool can share the blocks; each sample is written by one thread
and hears the views in order, so the result does not depend on the threads.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from gsbake.meshing.sparse_lattice import EDGE

#: Bits of `seen`: a depth saw the sample (in front of or near a surface); a mask excluded it.
BY_DEPTH, BY_MASK = 1, 2


#: What a view says about a block.
LOOK, NOTHING, BEHIND = 0, 1, 2
#: Edge of the tiles in which a view's reach is summed up, in pixels.
TILE = 8


@nb.njit(cache=True, nogil=True)
def reach_tiles(inverse_depth: Any, outside: Any, truncation: Any) -> Any:
    """Per tile of 8 x 8 pixels the z-depth behind which the view has nothing to say: -1 = nothing at all, inf = a mask speaks."""
    height, width = inverse_depth.shape
    out = np.full((-(-height // TILE), -(-width // TILE)), np.float32(-1))
    for v in range(height):
        for u in range(width):
            if outside[v, u] > 0:
                out[v // TILE, u // TILE] = np.inf
            elif inverse_depth[v, u] > 0:
                # One truncation behind the surface, one for interpolation between pixels.
                far = np.float32(1) / inverse_depth[v, u] + np.float32(2) * truncation
                out[v // TILE, u // TILE] = max(out[v // TILE, u // TILE], far)
    return out


@nb.njit(cache=True, nogil=True, inline="always")
def _glance(
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
    reach: Any,
) -> Any:
    """What a view says about a block (first sample x0, y0, z0): LOOK at its samples, NOTHING, or it lies BEHIND all that is shown."""
    half = np.float32((EDGE - 1) / 2) * cell
    x, y, z = x0 + half, y0 + half, z0 + half
    px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
    py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
    pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    radius = np.float32(1.7320508) * half
    if pz + radius <= 0:
        return NOTHING
    if pz <= np.float32(1.5) * radius:
        return LOOK
    rx, ry = px / pz, py / pz
    spread = radius / (pz - radius)
    du, dv = fx * spread * np.sqrt(1 + rx * rx), fy * spread * np.sqrt(1 + ry * ry)
    u, v = fx * rx + cx, fy * ry + cy
    if u + du < 0 or v + dv < 0 or u - du >= width or v - dv >= height:
        return NOTHING
    far = np.float32(-1)
    for row in range(max(0, int(v - dv) // TILE), min(reach.shape[0] - 1, int(v + dv) // TILE) + 1):
        for col in range(max(0, int(u - du) // TILE), min(reach.shape[1] - 1, int(u + du) // TILE) + 1):
            far = max(far, reach[row, col])
    if far < 0:
        return NOTHING
    return BEHIND if pz - radius > far else LOOK


@nb.njit(cache=True, nogil=True, error_model="numpy")
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
    outside: Any,
    reach: Any,
    hull_weight: Any,
    free_weight: Any,
    values: Any,
    totals: Any,
    seen: Any,
    hidden: Any,
    hidden_blocks: Any,
) -> None:
    """Add one view to blocks start..stop of the running means `values` (n, 8, 8, 8) with weights `totals` and flags `seen`.

    `hidden` and, for whole blocks, `hidden_blocks` (n,) count the views whose surface lies before the sample.

    `inverse_depth` (h, w) holds 1/z, 0 = none; `cosine` (h, w) the cosine between normal and ray; `outside` (h, w) the distance
    in pixels outside the object's mask (0 inside); `reach` is `reach_tiles` of the view; `intrinsics` is (fx, fy, cx, cy),
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
        glance = _glance(x0, y0, z0, cell, rotation, translation, fx, fy, cx, cy, width, height, reach)
        if glance == BEHIND:
            hidden_blocks[n] += 1
        if glance != LOOK:
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
                    slant = np.sqrt(one + rx * rx + ry * ry)
                    gap = outside[iv, iu]
                    if gap > 0:
                        vote = min(one, gap * z / (fx * truncation))
                        total = totals[n, i, j, k] + hull_weight
                        values[n, i, j, k] += (vote - values[n, i, j, k]) * hull_weight / total
                        totals[n, i, j, k] = total
                        seen[n, i, j, k] |= BY_MASK
                        continue
                    # Planes are linear in 1/z: interpolate that, unless the four pixels lie on both sides of a step.
                    s, t = u - half, v - half
                    iu0, iv0 = int(np.floor(s)), int(np.floor(t))
                    inv = inverse_depth[iv, iu]
                    if iu0 >= 0 and iv0 >= 0 and iu0 + 1 < width and iv0 + 1 < height:
                        a, b = inverse_depth[iv0, iu0], inverse_depth[iv0, iu0 + 1]
                        c, d = inverse_depth[iv0 + 1, iu0], inverse_depth[iv0 + 1, iu0 + 1]
                        low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
                        if low > 0 and (high - low) < truncation * low * high:
                            fu, fv = s - iu0, t - iv0
                            inv = (a * (one - fu) + b * fu) * (one - fv) + (c * (one - fu) + d * fu) * fv
                    share = weight[iv, iu]
                    if inv <= 0 or share <= 0:
                        continue
                    # Behind the surface the length along the ray counts: a grazing ray leaves a convex body soon after it
                    # entered, and what it says about the far side would swell the body.
                    along = (one / inv - z) * slant / truncation
                    if along < -one:
                        hidden[n, i, j, k] += 1
                        continue
                    distance = along * cosine[iv, iu]
                    if distance > one:
                        distance = one
                        share *= free_weight
                    elif along < -np.float32(0.25):
                        share *= np.float32(4.0 / 3.0) * (one + along)
                    total = totals[n, i, j, k] + share
                    if total > 0:
                        values[n, i, j, k] += (distance - values[n, i, j, k]) * share / total
                        totals[n, i, j, k] = total
                        # Farther behind, "inside" is a guess along this ray (below a rim it is wrong): left to the filling.
                        if along > -half:
                            seen[n, i, j, k] |= BY_DEPTH


@nb.njit(cache=True, nogil=True)
def mark_depth(
    inverse_depth: Any, outside: Any, to_lattice: Any, origin: Any, intrinsics: Any, reach: float, wanted: Any
) -> None:
    """Mark in `wanted` (blocks) those within `reach` samples of the points that a depth map shows.

    `to_lattice` (3, 3) turns camera directions into lattice samples, `origin` (3,) is the camera there.
    """
    height, width = inverse_depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    lo = np.zeros(3, np.int64)
    hi = np.zeros(3, np.int64)
    for v in range(height):
        for u in range(width):
            if inverse_depth[v, u] <= 0 or outside[v, u] > 0:
                continue
            z = 1.0 / inverse_depth[v, u]
            x = (u + 0.5 - cx) / fx * z
            y = (v + 0.5 - cy) / fy * z
            for a in range(3):
                p = to_lattice[a, 0] * x + to_lattice[a, 1] * y + to_lattice[a, 2] * z + origin[a]
                lo[a] = max(0, int(np.floor((p - reach) / EDGE)))
                hi[a] = min(wanted.shape[a] - 1, int(np.floor((p + reach) / EDGE)))
            for a in range(lo[0], hi[0] + 1):
                for b in range(lo[1], hi[1] + 1):
                    for c in range(lo[2], hi[2] + 1):
                        wanted[a, b, c] = True
