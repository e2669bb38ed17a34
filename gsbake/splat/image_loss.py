"""The per-pixel losses fused in Numba: value and gradient in one go (what torch does in some forty small operations).

Colour is (1 − λ) L1 + λ (1 − SSIM) with the 11-tap Gaussian window (Wang et al. 2004); the normal term compares blended normals with
the normals of
the expected depth (2DGS, Huang et al. 2024). The plain PyTorch twins are `losses.colour` and `losses.normal_consistency`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsbake.splat import losses
from gsbake.splat.blocks import FAST
from gsbake.splat.projection import Pinhole
from gsbake.splat.threads import run_chunks

_JIT: dict[str, Any] = {"nogil": True, "fastmath": FAST, "error_model": "numpy", "cache": True}
TAPS = 11
HALF = TAPS // 2
_x = np.arange(TAPS) - HALF
WINDOW = (np.exp(-(_x**2) / (2 * 1.5**2)) / np.exp(-(_x**2) / (2 * 1.5**2)).sum()).astype(np.float32)
C1, C2 = np.float32(1e-4), np.float32(9e-4)


@njit(**_JIT)
def _row_blur(source, pad, out, window):  # type: ignore[no-untyped-def]
    """Horizontal blur of one row; `pad` has 5 zeros on each side."""
    n = source.shape[0]
    pad[HALF : HALF + n] = source
    for x in range(n):
        acc = np.float32(0.0)
        for k in range(TAPS):
            acc += window[k] * pad[x + k]
        out[x] = acc


@njit(**_JIT)
def _moments(lo, hi, a, b, out, window):  # type: ignore[no-untyped-def]
    """Pass 1 over rows lo..hi of all planes: horizontal blur of a, b, a², b², ab into out (5, c, h, w)."""
    h, w = a.shape[1], a.shape[2]
    pad = np.zeros(w + 2 * HALF, np.float32)
    row = np.empty(w, np.float32)
    for i in range(lo, hi):
        c, y = i // h, i % h
        _row_blur(a[c, y], pad, out[0, c, y], window)
        _row_blur(b[c, y], pad, out[1, c, y], window)
        for x in range(w):
            row[x] = a[c, y, x] * a[c, y, x]
        _row_blur(row, pad, out[2, c, y], window)
        for x in range(w):
            row[x] = b[c, y, x] * b[c, y, x]
        _row_blur(row, pad, out[3, c, y], window)
        for x in range(w):
            row[x] = a[c, y, x] * b[c, y, x]
        _row_blur(row, pad, out[4, c, y], window)


@njit(**_JIT)
def _column_blur(plane, y, out, window):  # type: ignore[no-untyped-def]
    """Vertical blur of row y of plane (h, w) into out (w,)."""
    h, w = plane.shape
    for x in range(w):
        out[x] = np.float32(0.0)
    for k in range(TAPS):
        yy = y + k - HALF
        if 0 <= yy < h:
            f = window[k]
            for x in range(w):
                out[x] += f * plane[yy, x]


@njit(**_JIT)
def _similarity(lo, hi, blurred, partial, rows, window):  # type: ignore[no-untyped-def]
    """Pass 2: finish the blur, write ∂SSIM/∂(E a, E a², E ab) into partial (3, c, h, w) and each row's SSIM sum into rows."""
    h, w = blurred.shape[2], blurred.shape[3]
    m = np.empty((5, w), np.float32)
    one, two = np.float32(1.0), np.float32(2.0)
    for i in range(lo, hi):
        c, y = i // h, i % h
        for j in range(5):
            _column_blur(blurred[j, c], y, m[j], window)
        total = np.float32(0.0)
        for x in range(w):
            ma, mb = m[0, x], m[1, x]
            a1, a2 = two * ma * mb + C1, two * (m[4, x] - ma * mb) + C2
            b1, b2 = ma * ma + mb * mb + C1, m[2, x] - ma * ma + m[3, x] - mb * mb + C2
            inv = one / (b1 * b2)
            s = a1 * a2 * inv
            total += s
            d_var, d_cov = -s / b2, two * a1 * inv
            partial[0, c, y, x] = two * mb * a2 * inv - two * ma * s / b1 - two * ma * d_var - mb * d_cov
            partial[1, c, y, x] = d_var
            partial[2, c, y, x] = d_cov
        rows[i] = total


@njit(**_JIT)
def _colour_gradient(lo, hi, a, b, partial, share, grad, rows, window):  # type: ignore[no-untyped-def]
    """Pass 3: blur the partials back and add the L1 part; rows receives the L1 sums."""
    h, w = a.shape[1], a.shape[2]
    n = np.float32(a.shape[0] * h * w)
    pad = np.zeros(w + 2 * HALF, np.float32)
    g = np.empty((3, w), np.float32)
    column = np.empty(w, np.float32)
    for i in range(lo, hi):
        c, y = i // h, i % h
        for j in range(3):
            _column_blur(partial[j, c], y, column, window)
            _row_blur(column, pad, g[j], window)
        l1 = (np.float32(1.0) - share) / n
        ss = -share / n
        total = np.float32(0.0)
        for x in range(w):
            av, bv = a[c, y, x], b[c, y, x]
            d = av - bv
            total += abs(d)
            sign = np.float32(1.0) if d > 0 else (np.float32(-1.0) if d < 0 else np.float32(0.0))
            grad[c, y, x] = l1 * sign + ss * (g[0, x] + np.float32(2.0) * av * g[1, x] + bv * g[2, x])
        rows[i] = total


class _Colour(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, share: float) -> Tensor:
        a, b = image.detach().contiguous().numpy(), target.detach().contiguous().numpy()
        c, h, w = a.shape
        blurred, partial = np.empty((5, c, h, w), np.float32), np.empty((3, c, h, w), np.float32)
        grad, similarity, l1 = torch.empty(c, h, w), np.empty(c * h, np.float32), np.empty(c * h, np.float32)
        rows, s = c * h, np.float32(share)
        run_chunks(lambda lo, hi: _moments(lo, hi, a, b, blurred, WINDOW), rows, 2)
        run_chunks(lambda lo, hi: _similarity(lo, hi, blurred, partial, similarity, WINDOW), rows, 2)
        run_chunks(lambda lo, hi: _colour_gradient(lo, hi, a, b, partial, s, grad.numpy(), l1, WINDOW), rows, 2)
        ctx.save_for_backward(grad)
        n = c * h * w
        value = (1 - share) * l1.sum(dtype=np.float64) / n + share * (1 - similarity.sum(dtype=np.float64) / n)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Any:
        return ctx.saved_tensors[0] * upstream, None, None


def colour(image: Tensor, target: Tensor, ssim_share: float) -> Tensor:
    """(1 − λ) L1 + λ (1 − SSIM) of sRGB images (3, h, w) float32; gradient to `image` only. On a GPU the PyTorch twin runs."""
    if image.is_cuda:
        return losses.colour(image, target, ssim_share)
    return torch.Tensor(_Colour.apply(image, target, ssim_share))


@njit(**_JIT)
def _normal_rows(lo, hi, depth, alpha, normal, mask, rot, fx, fy, cx, cy, g_depth, g_alpha, g_normal, rows):  # type: ignore[no-untyped-def]
    """Value per row and gradients of Σ mask (alpha − n·n_depth), n_depth from the expected depth Σwz/Σw by central differences.

    Writes the gradient w.r.t. the expected depth of rows lo−1..hi+1 into g_depth with +=, so chunks run in two colours (even, odd).
    """
    h, w = depth.shape
    for y in range(lo, hi):
        total = np.float32(0.0)
        for x in range(w):
            m = mask[y, x]
            g_normal[0, y, x] = g_normal[1, y, x] = g_normal[2, y, x] = np.float32(0.0)
            g_alpha[y, x] = m
            total += m * alpha[y, x]
            if x == 0 or y == 0 or x == w - 1 or y == h - 1 or not m > np.float32(0.0):
                continue
            zl, zr, zt, zb = depth[y, x - 1], depth[y, x + 1], depth[y - 1, x], depth[y + 1, x]
            xl, xr, xm = (x - np.float32(0.5) - cx) / fx, (x + np.float32(1.5) - cx) / fx, (x + np.float32(0.5) - cx) / fx
            yt, yb, ym = (y - np.float32(0.5) - cy) / fy, (y + np.float32(1.5) - cy) / fy, (y + np.float32(0.5) - cy) / fy
            u0, u1, u2 = zr * xr - zl * xl, (zr - zl) * ym, zr - zl
            v0, v1, v2 = (zb - zt) * xm, zb * yb - zt * yt, zb - zt
            n0, n1, n2 = v1 * u2 - v2 * u1, v2 * u0 - v0 * u2, v0 * u1 - v1 * u0
            length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if not length > np.float32(1e-12):
                continue
            inv = np.float32(1.0) / length
            n0, n1, n2 = n0 * inv, n1 * inv, n2 * inv
            # blended normal in the camera frame
            w0, w1, w2 = normal[0, y, x], normal[1, y, x], normal[2, y, x]
            c0 = rot[0, 0] * w0 + rot[0, 1] * w1 + rot[0, 2] * w2
            c1 = rot[1, 0] * w0 + rot[1, 1] * w1 + rot[1, 2] * w2
            c2 = rot[2, 0] * w0 + rot[2, 1] * w1 + rot[2, 2] * w2
            dot = n0 * c0 + n1 * c1 + n2 * c2
            total -= m * dot
            for j in range(3):
                g_normal[j, y, x] = -m * (rot[0, j] * n0 + rot[1, j] * n1 + rot[2, j] * n2)
            # through the normalisation and the cross product v × u
            g0, g1, g2 = -m * inv * (c0 - dot * n0), -m * inv * (c1 - dot * n1), -m * inv * (c2 - dot * n2)
            gv0, gv1, gv2 = u1 * g2 - u2 * g1, u2 * g0 - u0 * g2, u0 * g1 - u1 * g0
            gu0, gu1, gu2 = g1 * v2 - g2 * v1, g2 * v0 - g0 * v2, g0 * v1 - g1 * v0
            g_depth[y, x + 1] += gu0 * xr + gu1 * ym + gu2
            g_depth[y, x - 1] -= gu0 * xl + gu1 * ym + gu2
            g_depth[y + 1, x] += gv0 * xm + gv1 * yb + gv2
            g_depth[y - 1, x] -= gv0 * xm + gv1 * yt + gv2
        rows[y] = total


class _Normal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depth: Tensor, alpha: Tensor, normal: Tensor, mask: Tensor, R: Tensor, view: Pinhole) -> Tensor:
        d, a, n, m, r = (x.detach().contiguous().numpy() for x in (depth, alpha, normal, mask, R))
        h, w = d.shape
        g_depth, g_alpha, g_normal = torch.zeros(h, w), torch.empty(h, w), torch.empty(3, h, w)
        gd, ga, gn = g_depth.numpy(), g_alpha.numpy(), g_normal.numpy()
        rows = np.empty(h, np.float32)
        p = [np.float32(v) for v in (view.fx, view.fy, view.cx, view.cy)]
        band = 16

        def work(colour_: int) -> Any:
            def run(lo: int, hi: int) -> None:
                for i in range(lo, hi):
                    start = (2 * i + colour_) * band
                    _normal_rows(start, min(start + band, h), d, a, n, m, r, *p, gd, ga, gn, rows)

            return run

        bands = -(-h // band)
        run_chunks(work(0), (bands + 1) // 2, 2)
        run_chunks(work(1), bands // 2, 2)
        count = max(1.0, float(m.sum(dtype=np.float64)))
        ctx.save_for_backward(g_depth, g_alpha, g_normal)
        ctx.count = count
        return torch.tensor(rows.sum(dtype=np.float64) / count, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> Any:
        factor = upstream / ctx.count
        return *(g * factor for g in ctx.saved_tensors), None, None, None


def normal_consistency(depth: Tensor, alpha: Tensor, normals: Tensor, mask: Tensor, R: Tensor, view: Pinhole) -> Tensor:
    """Mean over `mask` of (Σw − Σw n · n_depth): blended world normals (3, h, w) against those of the expected depth (h, w). On a GPU
    the PyTorch twin runs."""
    if depth.is_cuda:
        return losses.normal_consistency(normals, alpha, losses.depth_normals(depth, R, view), mask)
    return torch.Tensor(_Normal.apply(depth, alpha, normals, mask, R, view))
