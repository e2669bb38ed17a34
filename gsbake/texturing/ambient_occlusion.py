"""Ambient occlusion per texel: the unoccluded share of the cosine-weighted hemisphere.

Directions follow the additive R2 sequence, shifted per texel by a hash (Cranley-Patterson rotation): stratified and deterministic. A small
filter removes the noise by averaging neighbouring texels of the same surface and orientation.

Roberts, *The unreasonable effectiveness of quasirandom sequences*, 2018 (R2); Malley's method for cosine-weighted directions (Pharr, Jakob
& Humphreys, *Physically Based Rendering*, section 13.6).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.raycast import RayCaster
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]

#: Steps of the R2 sequence: 1/g and 1/g² of the plastic number g.
R2 = (0.7548776662466927, 0.5698402909980532)
#: Radius of the filter in texels.
FILTER_RADIUS = 2


def occlusion(
    position: NDArray[Any],
    normal: NDArray[Any],
    caster: RayCaster,
    rays: int,
    offset: float,
    each: Callable[[int, int], None] | None = None,
) -> Floats:
    """Ambient occlusion (n,) at each `position` (n, 3) with unit `normal` (n, 3), 0..1, 1 = open.

    Rays start `offset` (mesh units) above the surface; `each(done, total)` is called after every round of one ray per texel.
    """
    p = np.ascontiguousarray(np.asarray(position, np.float64) + offset * np.asarray(normal, np.float64))
    n = np.ascontiguousarray(normal, np.float32)
    blocked = np.zeros(len(p), np.int32)
    directions = np.zeros((len(p), 3), np.float32)
    for k in range(rays):
        run_chunks(lambda lo, hi, k=k: _directions(lo, hi, n, k, rays, directions), len(n))  # type: ignore[misc]
        blocked += caster.occluded(p, directions)
        if each is not None:
            each(k + 1, rays)
    return (1 - blocked / max(rays, 1)).astype(np.float32)


@kernel("i8, i8, f4[:, ::1], i8, i8, f4[:, ::1]", nogil=True, error_model="numpy")
def _directions(lo: int, hi: int, normal: Floats, k: int, rays: int, out: Floats) -> None:
    """Write the k-th of `rays` cosine-weighted directions about the normals lo..hi of `normal` (n, 3) to `out` (n, 3)."""
    for i in range(lo, hi):
        h = np.uint32(i) * np.uint32(747796405) + np.uint32(2891336453)
        h = ((h >> ((h >> np.uint32(28)) + np.uint32(4))) ^ h) * np.uint32(277803737)
        h = (h >> np.uint32(22)) ^ h
        shift_a = (h & np.uint32(0xFFFF)) / 65536.0
        shift_b = ((h >> np.uint32(16)) & np.uint32(0xFFFF)) / 65536.0
        a = (0.5 + k * R2[0] + shift_a) % 1.0
        b = (0.5 + k * R2[1] + shift_b) % 1.0
        disc_radius, azimuth = np.sqrt(a), 2 * np.pi * b
        x, y, z = disc_radius * np.cos(azimuth), disc_radius * np.sin(azimuth), np.sqrt(max(0.0, 1 - a))
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        # Branch-free basis about the normal: Duff et al., JCGT 2017.
        sign = np.float32(1 if nz >= 0 else -1)
        c = -1 / (sign + nz)
        d = nx * ny * c
        out[i, 0] = x * (1 + sign * nx * nx * c) + y * d + z * nx
        out[i, 1] = x * sign * d + y * (sign + ny * ny * c) + z * ny
        out[i, 2] = -x * sign * nx + -y * ny + z * nz


def smooth_over_surface(texels: Texels, value: Floats, position: NDArray[Any], normal: NDArray[Any], radius: float) -> Floats:
    """`value` (n,) or (n, c), not negative, averaged over neighbouring texels within `radius` (mesh units) with similar normals."""
    values = texels.image(value, np.nan)
    positions, normals, reach, out = texels.image(position), texels.image(normal), np.float32(radius), values.copy()
    run_chunks(lambda lo, hi: _filter(lo, hi, values, positions, normals, reach, out), len(values))
    return np.asarray(out.reshape(-1, out.shape[2])[texels.index].reshape(value.shape), np.float32)


@kernel("i8, i8, f4[:, :, ::1], f4[:, :, ::1], f4[:, :, ::1], f4, f4[:, :, ::1]", nogil=True, error_model="numpy")
def _filter(lo: int, hi: int, value: Floats, position: Floats, normal: Floats, radius: np.float32, out: Floats) -> None:
    """Write the mean of `value` (s, s, c; NaN where empty) over neighbouring texels, weighted by distance and similarity of normals, to the
    rows lo..hi of `out`, a copy of `value`."""
    size, channels = value.shape[0], value.shape[2]
    total = np.empty(channels)
    for j in range(lo, hi):
        for i in range(size):
            if not value[j, i, 0] >= 0:
                continue
            total[:] = 0.0
            weight: Any = 0.0
            for y in range(max(0, j - FILTER_RADIUS), min(size, j + FILTER_RADIUS + 1)):
                for x in range(max(0, i - FILTER_RADIUS), min(size, i + FILTER_RADIUS + 1)):
                    if not value[y, x, 0] >= 0:
                        continue
                    distance2, cosine = 0.0, 0.0
                    for c in range(3):
                        distance2 += (position[y, x, c] - position[j, i, c]) ** 2
                        cosine += normal[y, x, c] * normal[j, i, c]
                    if distance2 > radius * radius or cosine < 0.8:
                        continue
                    w = (cosine - 0.8) * (1.0001 - distance2 / (radius * radius))
                    for c in range(channels):
                        total[c] += w * value[y, x, c]
                    weight += w
            if weight > 0:
                for c in range(channels):
                    out[j, i, c] = total[c] / weight
