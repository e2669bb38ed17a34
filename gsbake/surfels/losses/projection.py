"""The projection loss of Zhu et al. 2025 in one pass over the surfels, value and gradient (Numba); its twin is `terms.projection_loss`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.surfels.losses import terms as losses
from gsbake.surfels.losses.geometry import ALPHA_SURFACE
from gsbake.surfels.losses.terms import PROJECTION_ERROR_MAX
from gsbake.surfels.raster.blocks import JIT
from gsbake.surfels.raster.projection import Pinhole

#: Surfels of one sum; fixed, so that the total does not depend on the number of threads.
CHUNK = 4096
NEAREST, RANGE, WHOLE = np.float32(1e-3), np.float32(PROJECTION_ERROR_MAX), np.float32(0.999)
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@kernel("i8, i8, f4[:, ::1], f4[:, ::1], f4[::1], b1[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], f4[::1], f4[::1]", **JIT)
def _forward(lo, hi, position, normal, sdf, visible, depth, alpha, rot, t, camera, sign):  # type: ignore[no-untyped-def]
    """Summed error and number of the surfels that count; `sign` (n,) receives each one's ∂|D − z|/∂z."""
    h, w = depth.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    total, count = _ZERO, 0
    for i in range(lo, hi):
        sign[i] = _ZERO
        if not visible[i]:
            continue
        s = sdf[i]
        m0, m1, m2 = position[i, 0] - s * normal[i, 0], position[i, 1] - s * normal[i, 1], position[i, 2] - s * normal[i, 2]
        z = rot[2, 0] * m0 + rot[2, 1] * m1 + rot[2, 2] * m2 + t[2]
        held = max(z, NEAREST)
        x = fx * (rot[0, 0] * m0 + rot[0, 1] * m1 + rot[0, 2] * m2 + t[0]) / held + (cx - _HALF)
        y = fy * (rot[1, 0] * m0 + rot[1, 1] * m1 + rot[1, 2] * m2 + t[1]) / held + (cy - _HALF)
        # positive form, so that NaN is skipped; what is farther out has no pixel beside it
        if not (x > -_ONE and x < np.float32(w) and y > -_ONE and y < np.float32(h)):
            continue
        x0, y0 = int(np.floor(x)), int(np.floor(y))
        seen, there = _ZERO, _ZERO
        for dy in range(2):
            for dx in range(2):
                c, r = x0 + dx, y0 + dy
                if 0 <= c < w and 0 <= r < h and alpha[r, c] > ALPHA_SURFACE and depth[r, c] > _ZERO:
                    f = (x - x0 if dx else _ONE - (x - x0)) * (y - y0 if dy else _ONE - (y - y0))
                    seen += np.float32(f) * (depth[r, c] / alpha[r, c])
                    there += np.float32(f)
        error = abs(seen - held)
        if there > WHOLE and error < RANGE:
            total += error
            count += 1
            if z >= NEAREST:
                sign[i] = _ONE if held > seen else (-_ONE if held < seen else _ZERO)
    return total, count


@kernel("i8, i8, f4[:, ::1], f4[::1], f4[:, ::1], f4, f4[::1], f4[:, ::1], f4[:, ::1], f4[::1]", **JIT)
def _backward(lo, hi, normal, sdf, rot, factor, sign, g_position, g_normal, g_sdf):  # type: ignore[no-untyped-def]
    for i in range(lo, hi):
        g = factor * sign[i]
        g0, g1, g2 = g * rot[2, 0], g * rot[2, 1], g * rot[2, 2]
        g_position[i, 0], g_position[i, 1], g_position[i, 2] = g0, g1, g2
        g_normal[i, 0], g_normal[i, 1], g_normal[i, 2] = -sdf[i] * g0, -sdf[i] * g1, -sdf[i] * g2
        g_sdf[i] = -(g0 * normal[i, 0] + g1 * normal[i, 1] + g2 * normal[i, 2])


class _ProjectionLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, position: Tensor, normal: Tensor, sdf: Tensor, visible: Tensor, depth: Tensor, alpha: Tensor, R: Tensor, t: Tensor,
        view: Pinhole,
    ) -> Tensor:  # fmt: skip
        p, n, s, v, d, a, r, o = (x.detach().contiguous().numpy() for x in (position, normal, sdf, visible, depth, alpha, R, t))
        camera, sign = np.array([view.fx, view.fy, view.cx, view.cy], np.float32), np.empty(len(s), np.float32)
        chunks = -(-len(s) // CHUNK)
        sums = np.zeros((chunks, 2))

        def work(lo: int, hi: int) -> None:
            for c in range(lo, hi):
                sums[c] = _forward(c * CHUNK, min(len(s), (c + 1) * CHUNK), p, n, s, v, d, a, r, o, camera, sign)

        run_chunks(work, chunks, 2)
        error, count = sums.sum(0)
        ctx.arrays, ctx.count = (n, s, r, sign), max(1.0, float(count))
        return torch.tensor(error / ctx.count, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Any:
        n, s, r, sign = ctx.arrays
        grads = torch.empty(len(s), 3), torch.empty(len(s), 3), torch.empty(len(s))
        outs, factor = [g.numpy() for g in grads], np.float32(float(upstream) / ctx.count)
        run_chunks(lambda lo, hi: _backward(lo, hi, n, s, r, factor, sign, *outs), len(s), 2, CHUNK)
        return *grads, None, None, None, None, None, None


def projection_loss(
    position: Tensor, normal: Tensor, sdf: Tensor, visible: Tensor, depth: Tensor, alpha: Tensor, R: Tensor, t: Tensor, view: Pinhole
) -> Tensor:
    """`terms.projection_loss` on the CPU, in one go; on a GPU that twin itself. Gradients to position, normal and sdf."""
    if position.is_cuda:
        return losses.projection_loss(position, normal, sdf, visible, depth, alpha, R, t, view)
    return torch.Tensor(_ProjectionLoss.apply(position, normal, sdf, visible, depth, alpha, R, t, view))
