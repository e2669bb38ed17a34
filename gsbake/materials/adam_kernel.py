"""Numba kernel of the update of texels in a step of the material fit: the priors' gradients, and Adam (Kingma & Ba 2015).

`adam_step` adds the priors to the gradient of a photo (`fit_kernel`) and updates each texel from its neighbours' old values. All literals
are float32: a float64 constant would widen the whole expression.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

from gsbake.kernels.declaration import kernel
from gsbake.materials.fit_kernel import PARAMETERS, srgb_and_slope
from gsbake.shading.split_sum_kernel import _FLAGS, CHUNKS

_0, _1, _2, _HALF, _SIXTH = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5), np.float32(1 / 6)
_16, _32 = np.float32(16), np.float32(32)


@njit(forceinline=True, **_FLAGS)
def _logistic(x: Any) -> Any:
    """1 / (1 + e^−x), off by 1e-6 at most: e^x from a polynomial at x/32 and five squarings, which are vector instructions."""
    x = min(max(x, -_16), _16) / -_32
    e = _1 + x * (_1 + x * (_HALF + x * (_SIXTH + x * (_HALF * _HALF * _SIXTH + x * np.float32(1 / 120)))))
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return _1 / (_1 + e)


@kernel(
    "f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], i8[::1], i4[::1], f4[::1], f4[::1], f4, f4[:, ::1], f4[::1], "
    "f4[::1], f4, f4, f4, f4, f4",
    parallel=True,
    **_FLAGS,
)
def adam_step(
    raw: Any, values: Any, new_values: Any, data: Any, first: Any, second: Any, start: Any, neighbour: Any, smoothness: Any,
    mean_weight: Any, offset_weight: Any, common: Any, common_weight: Any, rate: Any, beta1: Any, beta2: Any, correction1: Any,
    correction2: Any, epsilon: Any,
) -> None:  # fmt: skip
    """One Adam step on all texels, with the priors' gradients added to `data` (texels, PARAMETERS), which is set to zero.

    `raw` (texels, PARAMETERS) are logits, for the normal offset the values themselves; `values` the old values, `new_values` the new ones.
    `start`, `neighbour` is the adjacency list; `smoothness` (PARAMETERS,) weighs |Δ| of the materials and Δ² of the normal offsets of each
    pair, `mean_weight` (PARAMETERS,) the values (of base colour the diffuse part), `offset_weight` the squared normal offset; `common`
    (texels or 0, 4) with `common_weight` (4,) draws sRGB base colour and roughness. `rate` (PARAMETERS,) learning rates, without one of
    normal offsets these and their moments stay; `first`, `second` moments.
    """
    regular, moves, texels = common.shape[0] > 0, rate[5] > _0, raw.shape[0]
    size = -(-texels // CHUNKS)
    for chunk in prange(CHUNKS):
        g = np.empty(PARAMETERS, np.float32)
        # Loops over parameters have fixed bounds, so that they are vector instructions.
        for texel in range(chunk * size, min(texels, (chunk + 1) * size)):
            t = np.uint64(texel)
            g[:] = _0
            for e in range(np.uint64(start[t]), np.uint64(start[t + np.uint64(1)])):
                other = np.uint64(neighbour[e])
                for c in range(PARAMETERS):
                    change = values[t, c] - values[other, c]
                    g[c] += np.float32(change > _0) - np.float32(change < _0) if c < 5 else _2 * change
            for c in range(PARAMETERS):
                g[c] = data[t, c] + smoothness[c] * g[c] + mean_weight[c] * (_1 - values[t, 4] if c < 3 else _1)  # its diffuse part
                data[t, c] = _0
            if regular:
                for c in range(3):
                    encoded, slope = srgb_and_slope(values[t, c])
                    g[c] += common_weight[c] * (encoded - common[t, c]) * slope
                g[3] += common_weight[3] * (values[t, 3] - common[t, 3])
            for c in range(PARAMETERS):
                g[c] = g[c] * values[t, c] * (_1 - values[t, c]) if c < 5 else g[c] + _2 * offset_weight * values[t, c]
            for c in range(PARAMETERS):
                if c < 5 or moves:
                    m = beta1 * first[t, c] + (_1 - beta1) * g[c]
                    s = beta2 * second[t, c] + (_1 - beta2) * g[c] * g[c]
                    first[t, c], second[t, c] = m, s
                    raw[t, c] -= rate[c] * m * correction1 / (math.sqrt(s * correction2) + epsilon)
                new_values[t, c] = _logistic(raw[t, c]) if c < 5 else raw[t, c]
