"""Inline Numba functions for fits of materials: what the specular lobe sees of the object itself.

Where it is blocked follows from ambient occlusion and from one traced ray. What it sees there follows from the light transport of the texel
that the ray meets: its diffuse radiosity, its emission, and the environment that it reflects in turn. The PyTorch twin is
`tests/materials/reference.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from gsbake.shading.split_sum_kernel import (
    _CLAMP_TERM,
    _FLAGS,
    _bilinear,
    _encode,
    _mirror_weight,
    _roughness_level,
    _table_cell,
    _table_value,
    _taps,
)

_0, _1, _2, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_16, _LOG_2 = np.float32(16), np.float32(math.log(2))
_MIN_OCCLUSION_BASE = np.float32(1e-3)

#: Least share of the hemisphere that blocks the light where indirect light is divided by it.
MIN_BLOCKED = 0.1
_MIN_BLOCKED = np.float32(MIN_BLOCKED)


@njit(forceinline=True, **_FLAGS)
def specular_occlusion(cosine: Any, roughness: Any, occlusion: Any) -> Any:
    """Specular occlusion of Lagarde & de Rousiers for a positive `cosine`."""
    exponent = math.exp(-_LOG_2 * (_16 * roughness + _1))  # an exponential takes half the time of a power
    power = math.exp(exponent * math.log(max(min(cosine, _1) + occlusion, _MIN_OCCLUSION_BASE)))
    return min(max(power - _1 + occlusion, _0), _1)


@njit(forceinline=True, **_FLAGS)
def specular_visibility(cosine: Any, roughness: Any, occlusion: Any, reflected: Any, i: Any) -> Any:
    """Visible share of the specular lobe of pixel i; what the indirect irradiance / π is multiplied by for the light of the rest; weight of
    the radiance that a traced ray meets, and the texel where it does.

    `reflected` (n,) as in `shade_and_differentiate`, empty: not traced.
    """
    visible, mirror = specular_occlusion(cosine, roughness, occlusion), _mirror_weight(roughness)
    blocked = (_1 - visible) / max(_1 - occlusion, _MIN_BLOCKED)
    incident = _0
    hit = np.uint64(0)
    if reflected.shape[0] > 0:
        visible *= _1 - mirror
        blocked *= _1 - mirror
        if reflected[i] >= 0:
            incident = mirror
            hit = np.uint64(reflected[i])
        else:
            visible += mirror
    return visible, blocked, incident, hit


@njit(forceinline=True, **_FLAGS)
def reflected_radiance(
    transport: Any, hit: Any, x: Any, y: Any, z: Any, table: Any, knots: Any, sizes: Any, offsets: Any, lut: Any, out: Any
) -> None:
    """Set `out` (3,) to the radiance that the texel `hit` sends against the ray x, y, z that meets it.

    Of what blocks its specular lobe the mean radiance counts, which its indirect light tells.
    """
    met = transport[hit]
    nx, ny, nz = met.normal[0], met.normal[1], met.normal[2]
    roughness, occlusion, metal = met.roughness, met.occlusion, met.metallic
    c = -(nx * x + ny * y + nz * z)
    soft = _HALF * (c + math.sqrt(c * c + _CLAMP_TERM))
    row, col, fx, fy = _table_cell(math.sqrt(soft), roughness, lut)
    scale = _table_value(lut, row, col, fx, fy, 0)
    bias = _table_value(lut, row, col, fx, fy, 1)
    share = _table_value(lut, row, col, fx, fy, 2)
    mirror = _table_value(lut, row, col, fx, fy, 4)
    dielectric = _table_value(lut, row, col, fx, fy, 5)
    coeff = _1 + mirror * (_2 * c - _1)
    u, v = _encode(coeff * nx + mirror * x, coeff * ny + mirror * y, coeff * nz + mirror * z)
    level, t = _roughness_level(_table_value(lut, row, col, fx, fy, 3), knots)
    base0, stride0, fx0, fy0 = _taps(u, v, sizes[level], offsets[level])
    base1, stride1, fx1, fy1 = _taps(u, v, sizes[level + 1], offsets[level + 1])
    u, v = _encode(nx, ny, nz)
    last = sizes.shape[0] - 1
    base2, stride2, fx2, fy2 = _taps(u, v, sizes[last], offsets[last])
    visible = specular_occlusion(soft, roughness, occlusion)
    blocked = (_1 - visible) / max(_1 - occlusion, _MIN_BLOCKED)
    for ch in range(3):
        lower = _bilinear(table, base0, stride0, fx0, fy0, ch)
        upper = _bilinear(table, base1, stride1, fx1, fy1, ch)
        narrow = lower + t * (upper - lower)
        light = narrow + share * (_bilinear(table, base2, stride2, fx2, fy2, ch) - narrow)
        reflectance = met.metal_colour[ch] * scale + metal * bias + (_1 - metal) * dielectric
        specular = (visible * light + blocked * met.indirect[ch]) * reflectance
        out[ch] = (_1 - dielectric) * met.diffuse[ch] + met.emission[ch] + specular
