"""Colours from spherical harmonics of degree 0 to 2, forward and backward (Numba), and the PyTorch twin that runs on a GPU.

Real harmonics in the order and with the signs of the splatting literature (Kerbl et al. 2023), on the direction from the camera to the
surfel; no gradient goes to the direction. A colour is ½ + Σ coefficient · basis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.surfels.raster.blocks import JIT

SH0 = 0.28209479177387814  # Y_00
SH1 = 0.4886025119029199  # Y_1m
SH2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)  # xy, yz and xz; z²; x² − y²
_0, _1, _2, _3, _4 = (np.float32(x) for x in (SH0, SH1, *SH2))
_ONE, _TWO, _HALF, _MIN_LENGTH = np.float32(1.0), np.float32(2.0), np.float32(0.5), np.float32(1e-12)
_CHUNK = 4096


def twin(sh: Tensor, position: Tensor, centre: Tensor) -> Tensor:
    """`colours` in torch operations, any device and precision."""
    found = 0.5 + SH0 * sh[:, 0]
    if sh.shape[1] > 1:
        d = torch.nn.functional.normalize(position.detach() - centre, dim=1)
        x, y, z = d[:, :1], d[:, 1:2], d[:, 2:]
        found = found + SH1 * (z * sh[:, 2] - y * sh[:, 1] - x * sh[:, 3])
        if sh.shape[1] > 4:
            found = found + (
                SH2[0] * (x * y * sh[:, 4] - y * z * sh[:, 5] - x * z * sh[:, 7])
                + SH2[1] * (2 * z * z - x * x - y * y) * sh[:, 6]
                + SH2[2] * (x * x - y * y) * sh[:, 8]
            )
    return found


@njit(**JIT)
def _basis(position, centre, i, degree, basis):  # type: ignore[no-untyped-def]
    """The basis at surfel i; `basis` (9,)."""
    x, y, z = position[i, 0] - centre[0], position[i, 1] - centre[1], position[i, 2] - centre[2]
    inverse = _ONE / max(np.sqrt(x * x + y * y + z * z), _MIN_LENGTH)
    x, y, z = x * inverse, y * inverse, z * inverse
    basis[0] = _0
    if degree > 0:
        basis[1], basis[2], basis[3] = -_1 * y, _1 * z, -_1 * x
    if degree > 1:
        basis[4], basis[5], basis[7] = _2 * x * y, -_2 * y * z, -_2 * x * z
        basis[6], basis[8] = _3 * (_TWO * z * z - x * x - y * y), _4 * (x * x - y * y)


@kernel("i8, i8, f4[:, :, ::1], f4[:, ::1], f4[::1], i8, f4[:, ::1]", **JIT)
def _forward(lo, hi, sh, position, centre, degree, out):  # type: ignore[no-untyped-def]
    basis = np.zeros(9, np.float32)
    for i in range(np.uint64(lo), np.uint64(hi)):
        _basis(position, centre, i, degree, basis)
        for c in range(np.uint64(3)):
            value = _HALF
            for k in range(np.uint64(sh.shape[1])):
                value += basis[k] * sh[i, k, c]
            out[i, c] = value


@kernel("i8, i8, f4[:, ::1], f4[::1], i8, f4[:, ::1], f4[:, :, ::1]", **JIT)
def _backward(lo, hi, position, centre, degree, grad, g_sh):  # type: ignore[no-untyped-def]
    basis = np.zeros(9, np.float32)
    for i in range(np.uint64(lo), np.uint64(hi)):
        _basis(position, centre, i, degree, basis)
        for k in range(np.uint64(g_sh.shape[1])):
            for c in range(np.uint64(3)):
                g_sh[i, k, c] = basis[k] * grad[i, c]


class _Colours(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, position: Tensor, centre: Tensor) -> Tensor:
        s, p, c = (x.detach().contiguous().numpy() for x in (sh, position, centre))
        out, degree = torch.empty(len(s), 3), {1: 0, 4: 1, 9: 2}[s.shape[1]]
        o = out.numpy()
        run_chunks(lambda lo, hi: _forward(lo, hi, s, p, c, degree, o), len(s), 2, _CHUNK)
        ctx.arrays, ctx.shape = (p, c, degree), s.shape
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        g_sh = torch.empty(ctx.shape)
        g, out = grad.contiguous().numpy(), g_sh.numpy()
        run_chunks(lambda lo, hi: _backward(lo, hi, *ctx.arrays, g, out), len(g), 2, _CHUNK)
        return g_sh, None, None


def colours(sh: Tensor, position: Tensor, centre: Tensor) -> Tensor:
    """sRGB (n, 3), unclamped, of surfels at `position` (n, 3) seen from `centre` (3,); `sh` (n, 1, 4 or 9, 3)."""
    if sh.device.type != "cpu" or sh.dtype != torch.float32:
        return twin(sh, position, centre)
    return torch.Tensor(_Colours.apply(sh, position, centre))
