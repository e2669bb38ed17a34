"""Deferred shading inside the fused image losses: planes → G-buffer → light → sRGB picture, and the way back (Numba).

The shading itself is `gsbake.shading.split_sum_kernel`; here is what stands around it.
The twin is `gsbake.surfels.gbuffer.picture` with autograd.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from gsbake.imaging import srgb
from gsbake.kernels.threads import run_chunks
from gsbake.shading import brdf
from gsbake.shading import split_sum_kernel as kernels
from gsbake.shading.light_tables import LightTables
from gsbake.surfels.gbuffer import SHADING_ALPHA_MIN
from gsbake.surfels.raster.blocks import JIT
from gsbake.surfels.raster.lanes import EXP2_COEFFICIENTS, LANES, broadcast, exp2, load, log, select, store
from gsbake.surfels.views import TrainView

#: Features: base colour, roughness, metallic, normal; then the planes of `gsbake.surfels.raster.kernel`, alpha the fifth of them.
CHANNELS = 8
_ALPHA = CHANNELS + 4
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_CHUNK = 16384
_MIN_SQUARED_LENGTH = np.float32(1e-12)
# the sRGB curve (IEC 61966-2-1)
_KINK, _SLOPE, _SCALE, _OFFSET = (np.float32(x) for x in (srgb.LINEAR_THRESHOLD, srgb.SLOPE, srgb.SCALE, srgb.OFFSET))
_EXPONENT = np.float32(1 / 2.4)
_TO_BASE_2 = np.float32(1 / np.log(2))
_POWER = np.array(EXP2_COEFFICIENTS, np.float32)


@njit(**JIT)
def _gather(lo, hi, planes, size, width, index, rot, camera, normal, view, albedo, roughness, metallic):  # type: ignore[no-untyped-def]
    """G-buffer of the pixels at `index`: planes over alpha, unit normals, directions to the camera."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for i in range(np.uint64(lo), np.uint64(hi)):
        at = index[i]
        inverse = _ONE / planes[_ALPHA, at]
        for c in range(np.uint64(3)):
            albedo[i, c] = planes[c, at] * inverse
        roughness[i], metallic[i] = planes[3, at] * inverse, planes[4, at] * inverse
        n0, n1, n2 = planes[5, at] * inverse, planes[6, at] * inverse, planes[7, at] * inverse
        unit = _ONE / np.sqrt(max(n0 * n0 + n1 * n1 + n2 * n2, _MIN_SQUARED_LENGTH))
        normal[i, 0], normal[i, 1], normal[i, 2] = n0 * unit, n1 * unit, n2 * unit
        x = (np.float32(at % width) + _HALF - cx) / fx
        y = (np.float32(at // width) + _HALF - cy) / fy
        z = -_ONE / np.sqrt(x * x + y * y + _ONE)
        for c in range(np.uint64(3)):
            view[i, c] = z * (x * rot[0, c] + y * rot[1, c] + rot[2, c])


@njit(**JIT)
def _encode(lo, hi, linear, srgb, slope, p):  # type: ignore[no-untyped-def]
    """sRGB of linear values, clipped, and the curve's slope (beyond the ends that of the nearer end); blocks lo..hi of eight."""
    one, p1, p2, p3, p4, p5 = broadcast(p[0]), broadcast(p[1]), broadcast(p[2]), broadcast(p[3]), broadcast(p[4]), broadcast(p[5])
    zero, kink = broadcast(_ZERO), broadcast(_KINK)
    for i in range(lo, hi):
        at = np.uint64(i * LANES)
        x = load(linear, at)
        x = select(x < zero, zero, select(x > one, one, x))  # a NaN stays
        held = select(x < kink, kink, x)
        power = exp2(_TO_BASE_2 * _EXPONENT * log(held), one, p1, p2, p3, p4, p5)
        curved = x > kink
        store(srgb, at, select(curved, _SCALE * power - _OFFSET, _SLOPE * x))
        store(slope, at, select(curved, _SCALE * _EXPONENT * power / held, broadcast(_SLOPE)))


@njit(**JIT)
def _place(lo, hi, planes, index, srgb, picture):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(lo), np.uint64(hi)):
        at = index[i]
        for c in range(np.uint64(3)):
            picture[c, at] = srgb[i, c] * planes[_ALPHA, at]


@njit(**JIT)
def _take(lo, hi, planes, index, srgb, slope, g_picture, g_linear, grad):  # type: ignore[no-untyped-def]
    """The way back of `_place` and `_encode`: to the linear colours, and to alpha."""
    for i in range(np.uint64(lo), np.uint64(hi)):
        at = index[i]
        alpha, g_alpha = planes[_ALPHA, at], _ZERO
        for c in range(np.uint64(3)):
            g = g_picture[c, at]
            g_linear[i, c] = g * alpha * slope[i, c]
            g_alpha += g * srgb[i, c]
        grad[_ALPHA, at] += g_alpha


@njit(**JIT)
def _scatter(lo, hi, planes, index, normal, albedo, roughness, metallic, g_normal, g_albedo, g_roughness, g_metallic, grad):  # type: ignore[no-untyped-def]
    """The way back of `_gather`, added to `grad`."""
    for i in range(np.uint64(lo), np.uint64(hi)):
        at = index[i]
        inverse = _ONE / planes[_ALPHA, at]
        n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
        b0, b1, b2 = planes[5, at], planes[6, at], planes[7, at]
        square = (b0 * b0 + b1 * b1 + b2 * b2) * inverse * inverse
        unit = _ONE / np.sqrt(max(square, _MIN_SQUARED_LENGTH))
        g0, g1, g2 = g_normal[i, 0], g_normal[i, 1], g_normal[i, 2]
        along = g0 * n0 + g1 * n1 + g2 * n2 if square > _MIN_SQUARED_LENGTH else _ZERO
        factor = unit * inverse
        g0, g1, g2 = factor * (g0 - along * n0), factor * (g1 - along * n1), factor * (g2 - along * n2)
        grad[5, at] += g0
        grad[6, at] += g1
        grad[7, at] += g2
        g_alpha = (g0 * b0 + g1 * b1 + g2 * b2) + g_roughness[i] * roughness[i] + g_metallic[i] * metallic[i]
        for c in range(np.uint64(3)):
            g_alpha += g_albedo[i, c] * albedo[i, c]
            grad[c, at] += g_albedo[i, c] * inverse
        grad[3, at] += g_roughness[i] * inverse
        grad[4, at] += g_metallic[i] * inverse
        grad[_ALPHA, at] -= g_alpha * inverse


class DeferredShading:
    """One photo's shading: made with the picture, kept for the gradient."""

    def __init__(self, planes: Any, view: TrainView, tables: LightTables) -> None:
        """Shade the blended planes (14, h, w), a contiguous float32 array, where alpha is above `ALPHA_SHADED`."""
        _, h, w = planes.shape
        self.planes, layout = planes.reshape(len(planes), -1), tables.layout
        self.index = np.flatnonzero(self.planes[_ALPHA] > SHADING_ALPHA_MIN)
        n = self.count = len(self.index)
        normal, direction, albedo = (np.empty((n, 3), np.float32) for _ in range(3))
        roughness, metallic = (np.empty(n, np.float32) for _ in range(2))
        lens = view.pinhole
        camera, rot = np.array([lens.fx, lens.fy, lens.cx, lens.cy], np.float32), view.R.detach().contiguous().numpy()
        self.geometry = (normal, albedo, roughness, metallic)
        args = (self.planes, h * w, w, self.index, rot, camera, normal, direction, albedo, roughness, metallic)
        run_chunks(lambda lo, hi: _gather(lo, hi, *args), n, 2, _CHUNK)
        opened = np.ones(n, np.float32)
        self.light = (
            normal, direction, albedo, roughness, metallic, opened, opened, tables.table.detach().contiguous().numpy(),
            np.array(layout.roughness, np.float32), np.array(layout.sizes, np.int64), np.array(layout.offsets, np.int64),
            brdf.split_sum_table(),
        )  # fmt: skip
        blocks = -(-3 * n // LANES)
        linear, srgb, slope = (np.zeros(blocks * LANES, np.float32) for _ in range(3))
        kernels.forward(*self.light, linear[: 3 * n].reshape(n, 3))
        run_chunks(lambda lo, hi: _encode(lo, hi, linear, srgb, slope, _POWER), blocks, 2, _CHUNK)
        self.srgb, self.slope = (x[: 3 * n].reshape(n, 3) for x in (srgb, slope))
        self.picture = np.zeros((3, h * w), np.float32)
        run_chunks(lambda lo, hi: _place(lo, hi, self.planes, self.index, self.srgb, self.picture), n, 2, _CHUNK)

    def backward(self, g_picture: Any, grad: Any) -> Any:
        """Add the picture's gradient (3, h w), handed down, to that of the planes (14, h w); returns the light table's."""
        n = self.count
        g_linear, g_normal, g_view, g_albedo = (np.empty((n, 3), np.float32) for _ in range(4))
        g_roughness, g_metallic, g_open, g_open_too = (np.empty(n, np.float32) for _ in range(4))
        taken = (self.planes, self.index, self.srgb, self.slope, g_picture, g_linear, grad)
        run_chunks(lambda lo, hi: _take(lo, hi, *taken), n, 2, _CHUNK)
        table = np.zeros((kernels.CHUNKS, *self.light[7].shape), np.float32)
        kernels.backward(*self.light, g_linear, g_normal, g_view, g_albedo, g_roughness, g_metallic, g_open, g_open_too, table)
        given = (self.planes, self.index, *self.geometry, g_normal, g_albedo, g_roughness, g_metallic, grad)
        run_chunks(lambda lo, hi: _scatter(lo, hi, *given), n, 2, _CHUNK)
        return table.sum(0)
