"""From surfels in the world to nine screen numbers each, with analytic gradients (Numba).

With camera-space centre c, unit tangents T, B, normal N = T × B, h = N·c and k = c_z / h, the plane hit in centre-relative pixels
(dx, dy) is u = (ux dx + uy dy)/den, v = (vx dx + vy dy)/den, den = 1 + wx dx + wy dy, z = c_z/den, where

    (ux, uy) = k/s_u · ((B×c)_x/f_x, (B×c)_y/f_y)     (vx, vy) = k/s_v · ((c×T)_x/f_x, (c×T)_y/f_y)     (wx, wy) = k · (N_x/f_x, N_y/f_y)

(the ray–plane intersection of 2DGS, Huang et al. 2024, with the centre's ray subtracted: nothing cancels for small surfels).
The screen box is exact: the tangents to the projected disc of radius √(2 ln(255 o)), joined with the low-pass disc.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.surfels.raster.blocks import FASTMATH
from gsbake.surfels.raster.kernel import ALPHA_MIN

#: |cos| between ray and plane below which a surfel counts as edge-on and is skipped.
EDGE_ON_COS = 1e-3
#: Coefficients are clamped to this: a surfel far smaller than a pixel is all low-pass anyway.
COEF_MAX = np.float32(1e8)
NEAR_Z = np.float32(0.02)
#: Scales (unit frame) below this count as this; the quaternion's squared length likewise, below which it has no gradient.
SCALE_MIN, QUATERNION_MIN = np.float32(1e-12), np.float32(1e-30)
#: A surfel of this scale or more (or of none that is a number) is skipped: its square no longer fits a float32.
SCALE_MAX = np.float32(1e18)

_JIT: dict[str, Any] = {"nogil": True, "fastmath": FASTMATH, "error_model": "numpy", "cache": True}


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics and size of one view, in pixels (plain floats, no gradient)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@njit(**_JIT)
def _rotation(q0, q1, q2, q3):  # type: ignore[no-untyped-def]
    """Rotation matrix of a (w, x, y, z) quaternion of any length, row-major."""
    n = np.float32(1.0) / np.sqrt(max(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3, QUATERNION_MIN))
    w, x, y, z = q0 * n, q1 * n, q2 * n, q3 * n
    two = np.float32(2.0)
    one = np.float32(1.0)
    return (
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
        w, x, y, z, n,
    )  # fmt: skip


@njit(**_JIT)
def _extent(a, b, c, az, bz, cz, r2, focal, principal, size):  # type: ignore[no-untyped-def]
    """Extent in pixels of the projected disc along one axis; the whole screen when the disc reaches the camera plane."""
    lead = cz * cz - r2 * (az * az + bz * bz)
    if not lead > np.float32(1e-6) * cz * cz:
        return np.float32(-1e9), np.float32(1e9)
    mid = (c * cz - r2 * (a * az + b * bz)) / lead
    disc = mid * mid - (c * c - r2 * (a * a + b * b)) / lead
    half = np.sqrt(max(disc, np.float32(0.0)))
    return focal * (mid - half) + principal, focal * (mid + half) + principal


@kernel(
    "i8, i8, f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], f4[:, ::1], f4[::1], f4, f4, f4, f4, i8, i8, b1, f4[:, ::1], i4[:, ::1], "
    "b1[::1], f4[:, ::1]",
    **_JIT,
)
def _forward(lo, hi, mu, quat, log_scale, opacity, rot, t, fx, fy, cx, cy, width, height, cull, geo, box, visible, normal):  # type: ignore[no-untyped-def]
    for i in range(lo, hi):
        r00, r01, r02, r10, r11, r12, r20, r21, r22, _w, _x, _y, _z, _n = _rotation(quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3])
        normal[i, 0], normal[i, 1], normal[i, 2] = r02, r12, r22
        m0, m1, m2 = mu[i, 0], mu[i, 1], mu[i, 2]
        c0 = rot[0, 0] * m0 + rot[0, 1] * m1 + rot[0, 2] * m2 + t[0]
        c1 = rot[1, 0] * m0 + rot[1, 1] * m1 + rot[1, 2] * m2 + t[1]
        c2 = rot[2, 0] * m0 + rot[2, 1] * m1 + rot[2, 2] * m2 + t[2]
        visible[i] = False
        for j in range(9):
            geo[i, j] = np.float32(0.0)
        if not (c2 > NEAR_Z and opacity[i] > np.float32(ALPHA_MIN)):
            continue
        t0 = rot[0, 0] * r00 + rot[0, 1] * r10 + rot[0, 2] * r20
        t1 = rot[1, 0] * r00 + rot[1, 1] * r10 + rot[1, 2] * r20
        t2 = rot[2, 0] * r00 + rot[2, 1] * r10 + rot[2, 2] * r20
        b0 = rot[0, 0] * r01 + rot[0, 1] * r11 + rot[0, 2] * r21
        b1 = rot[1, 0] * r01 + rot[1, 1] * r11 + rot[1, 2] * r21
        b2 = rot[2, 0] * r01 + rot[2, 1] * r11 + rot[2, 2] * r21
        n0, n1, n2 = t1 * b2 - t2 * b1, t2 * b0 - t0 * b2, t0 * b1 - t1 * b0
        h = n0 * c0 + n1 * c1 + n2 * c2
        length = np.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
        if not abs(h) > np.float32(EDGE_ON_COS) * length:
            continue
        if cull and h > np.float32(0.0):
            continue
        su, sv = np.exp(log_scale[i, 0]), np.exp(log_scale[i, 1])
        if not (su < SCALE_MAX and sv < SCALE_MAX):
            continue
        k = c2 / h
        ku, kv = k / max(su, SCALE_MIN), k / max(sv, SCALE_MIN)
        xc, yc = fx * c0 / c2 + cx, fy * c1 / c2 + cy
        geo[i, 0], geo[i, 1] = xc, yc
        geo[i, 2] = min(max(ku * (b1 * c2 - b2 * c1) / fx, -COEF_MAX), COEF_MAX)
        geo[i, 3] = min(max(ku * (b2 * c0 - b0 * c2) / fy, -COEF_MAX), COEF_MAX)
        geo[i, 4] = min(max(kv * (c1 * t2 - c2 * t1) / fx, -COEF_MAX), COEF_MAX)
        geo[i, 5] = min(max(kv * (c2 * t0 - c0 * t2) / fy, -COEF_MAX), COEF_MAX)
        geo[i, 6] = k * n0 / fx
        geo[i, 7] = k * n1 / fy
        geo[i, 8] = c2
        r2 = np.float32(2.0) * np.log(np.float32(255.0) * opacity[i])
        x_lo, x_hi = _extent(t0 * su, b0 * sv, c0, t2 * su, b2 * sv, c2, r2, fx, cx, width)
        y_lo, y_hi = _extent(t1 * su, b1 * sv, c1, t2 * su, b2 * sv, c2, r2, fy, cy, height)
        low = np.sqrt(np.float32(0.5) * r2)
        x_lo, x_hi = min(x_lo, xc - low), max(x_hi, xc + low)
        y_lo, y_hi = min(y_lo, yc - low), max(y_hi, yc + low)
        # pixels whose centre j + .5 lies in [lo, hi]; positive form, so that NaN is skipped
        if not (x_hi >= np.float32(0.5) and x_lo <= np.float32(width) - np.float32(0.5)):
            continue
        if not (y_hi >= np.float32(0.5) and y_lo <= np.float32(height) - np.float32(0.5)):
            continue
        box[i, 0] = int(np.ceil(max(x_lo - np.float32(0.5), np.float32(0.0))))
        box[i, 1] = int(np.floor(min(x_hi - np.float32(0.5), np.float32(width - 1))))
        box[i, 2] = int(np.ceil(max(y_lo - np.float32(0.5), np.float32(0.0))))
        box[i, 3] = int(np.floor(min(y_hi - np.float32(0.5), np.float32(height - 1))))
        visible[i] = box[i, 0] <= box[i, 1] and box[i, 2] <= box[i, 3]


@kernel(
    "i8, i8, f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[::1], f4, f4, b1[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], "
    "f4[:, ::1], f4[:, ::1], f4[::1]",
    **_JIT,
)
def _backward(lo, hi, mu, quat, log_scale, rot, t, fx, fy, visible, geo, g_geo, g_normal, g_mu, g_quat, g_scale, g_pose):  # type: ignore[no-untyped-def]
    """g_pose (12,) collects this chunk's share of the gradients of R (row-major) and t."""
    for i in range(lo, hi):
        r00, r01, r02, r10, r11, r12, r20, r21, r22, qw, qx, qy, qz, qn = _rotation(quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3])
        gn_0, gn_1, gn_2 = g_normal[i, 0], g_normal[i, 1], g_normal[i, 2]  # world normal
        gr00 = gr10 = gr20 = gr01 = gr11 = gr21 = np.float32(0.0)
        for j in range(3):
            g_mu[i, j] = np.float32(0.0)
        g_scale[i, 0] = g_scale[i, 1] = np.float32(0.0)
        if visible[i]:
            m0, m1, m2 = mu[i, 0], mu[i, 1], mu[i, 2]
            c0 = rot[0, 0] * m0 + rot[0, 1] * m1 + rot[0, 2] * m2 + t[0]
            c1 = rot[1, 0] * m0 + rot[1, 1] * m1 + rot[1, 2] * m2 + t[1]
            c2 = rot[2, 0] * m0 + rot[2, 1] * m1 + rot[2, 2] * m2 + t[2]
            t0 = rot[0, 0] * r00 + rot[0, 1] * r10 + rot[0, 2] * r20
            t1 = rot[1, 0] * r00 + rot[1, 1] * r10 + rot[1, 2] * r20
            t2 = rot[2, 0] * r00 + rot[2, 1] * r10 + rot[2, 2] * r20
            b0 = rot[0, 0] * r01 + rot[0, 1] * r11 + rot[0, 2] * r21
            b1 = rot[1, 0] * r01 + rot[1, 1] * r11 + rot[1, 2] * r21
            b2 = rot[2, 0] * r01 + rot[2, 1] * r11 + rot[2, 2] * r21
            n0, n1, n2 = t1 * b2 - t2 * b1, t2 * b0 - t0 * b2, t0 * b1 - t1 * b0
            h = n0 * c0 + n1 * c1 + n2 * c2
            k = c2 / h
            su, sv = np.exp(log_scale[i, 0]), np.exp(log_scale[i, 1])
            isu, isv = np.float32(1.0) / max(su, SCALE_MIN), np.float32(1.0) / max(sv, SCALE_MIN)
            ifx, ify = np.float32(1.0) / fx, np.float32(1.0) / fy
            g0, g1 = g_geo[i, 0], g_geo[i, 1]
            # a clamped coefficient passes no gradient
            gux = g_geo[i, 2] if abs(geo[i, 2]) < COEF_MAX else np.float32(0.0)
            guy = g_geo[i, 3] if abs(geo[i, 3]) < COEF_MAX else np.float32(0.0)
            gvx = g_geo[i, 4] if abs(geo[i, 4]) < COEF_MAX else np.float32(0.0)
            gvy = g_geo[i, 5] if abs(geo[i, 5]) < COEF_MAX else np.float32(0.0)
            gwx, gwy, gz = g_geo[i, 6], g_geo[i, 7], g_geo[i, 8]
            g_scale[i, 0] = -(gux * geo[i, 2] + guy * geo[i, 3])
            g_scale[i, 1] = -(gvx * geo[i, 4] + gvy * geo[i, 5])
            # every coefficient but the centre is k times something
            gk = (gux * geo[i, 2] + guy * geo[i, 3] + gvx * geo[i, 4] + gvy * geo[i, 5] + gwx * geo[i, 6] + gwy * geo[i, 7]) / k
            p0, p1 = gux * k * isu * ifx, guy * k * isu * ify  # gradient of (B×c)_x, (B×c)_y
            s0, s1 = gvx * k * isv * ifx, gvy * k * isv * ify  # gradient of (c×T)_x, (c×T)_y
            gb0, gb1, gb2 = -p1 * c2, p0 * c2, p1 * c0 - p0 * c1
            gt0, gt1, gt2 = s1 * c2, -s0 * c2, s0 * c1 - s1 * c0
            gc0 = p1 * b2 - s1 * t2
            gc1 = -p0 * b2 + s0 * t2
            gc2 = p0 * b1 - p1 * b0 + s1 * t0 - s0 * t1
            gh = -gk * k / h
            gn0, gn1, gn2 = gwx * k * ifx + gh * c0, gwy * k * ify + gh * c1, gh * c2
            gc0 += gh * n0 + g0 * fx / c2
            gc1 += gh * n1 + g1 * fy / c2
            gc2 += gh * n2 + gk / h + gz - (g0 * fx * c0 + g1 * fy * c1) / (c2 * c2)
            # N = T × B
            gt0 += b1 * gn2 - b2 * gn1
            gt1 += b2 * gn0 - b0 * gn2
            gt2 += b0 * gn1 - b1 * gn0
            gb0 += gn1 * t2 - gn2 * t1
            gb1 += gn2 * t0 - gn0 * t2
            gb2 += gn0 * t1 - gn1 * t0
            g_mu[i, 0] = rot[0, 0] * gc0 + rot[1, 0] * gc1 + rot[2, 0] * gc2
            g_mu[i, 1] = rot[0, 1] * gc0 + rot[1, 1] * gc1 + rot[2, 1] * gc2
            g_mu[i, 2] = rot[0, 2] * gc0 + rot[1, 2] * gc1 + rot[2, 2] * gc2
            gr00 = rot[0, 0] * gt0 + rot[1, 0] * gt1 + rot[2, 0] * gt2
            gr10 = rot[0, 1] * gt0 + rot[1, 1] * gt1 + rot[2, 1] * gt2
            gr20 = rot[0, 2] * gt0 + rot[1, 2] * gt1 + rot[2, 2] * gt2
            gr01 = rot[0, 0] * gb0 + rot[1, 0] * gb1 + rot[2, 0] * gb2
            gr11 = rot[0, 1] * gb0 + rot[1, 1] * gb1 + rot[2, 1] * gb2
            gr21 = rot[0, 2] * gb0 + rot[1, 2] * gb1 + rot[2, 2] * gb2
            # camera pose: c = R μ + t, T = R T_w, B = R B_w
            g_pose[0] += gc0 * m0 + gt0 * r00 + gb0 * r01
            g_pose[1] += gc0 * m1 + gt0 * r10 + gb0 * r11
            g_pose[2] += gc0 * m2 + gt0 * r20 + gb0 * r21
            g_pose[3] += gc1 * m0 + gt1 * r00 + gb1 * r01
            g_pose[4] += gc1 * m1 + gt1 * r10 + gb1 * r11
            g_pose[5] += gc1 * m2 + gt1 * r20 + gb1 * r21
            g_pose[6] += gc2 * m0 + gt2 * r00 + gb2 * r01
            g_pose[7] += gc2 * m1 + gt2 * r10 + gb2 * r11
            g_pose[8] += gc2 * m2 + gt2 * r20 + gb2 * r21
            g_pose[9] += gc0
            g_pose[10] += gc1
            g_pose[11] += gc2
        if not qn * qn * QUATERNION_MIN < np.float32(0.99):
            qn = np.float32(0.0)
        two = np.float32(2.0)
        # d R / d unit quaternion, columns T = (r00, r10, r20), B = (r01, r11, r21), N = (r02, r12, r22)
        dw = two * (qz * (gr10 - gr01) + qy * (gn_0 - gr20) + qx * (gr21 - gn_1))
        dx = two * (qy * (gr01 + gr10) + qz * (gn_0 + gr20) + qw * (gr21 - gn_1)) - two * two * qx * (gr11 + gn_2)
        dy = two * (qx * (gr01 + gr10) + qw * (gn_0 - gr20) + qz * (gn_1 + gr21)) - two * two * qy * (gr00 + gn_2)
        dz = two * (qw * (gr10 - gr01) + qx * (gn_0 + gr20) + qy * (gn_1 + gr21)) - two * two * qz * (gr00 + gr11)
        along = dw * qw + dx * qx + dy * qy + dz * qz
        g_quat[i, 0] = (dw - along * qw) * qn
        g_quat[i, 1] = (dx - along * qx) * qn
        g_quat[i, 2] = (dy - along * qy) * qn
        g_quat[i, 3] = (dz - along * qz) * qn


def _numpy(x: Tensor) -> Any:
    return x.detach().contiguous().numpy()


class Project(torch.autograd.Function):
    """`apply(mu, quat, log_scale, opacity, R, t, pinhole, cull)` → `geo` (n, 9), world `normal` (n, 3), `box` (n, 4) int32, `visible` (n,).

    `opacity` only sizes the boxes: it gets no gradient here.
    """

    @staticmethod
    def forward(
        ctx: Any, mu: Tensor, quat: Tensor, log_scale: Tensor, opacity: Tensor, R: Tensor, t: Tensor, pinhole: Pinhole, cull: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Project; see the class."""
        n = mu.shape[0]
        geo, normal = torch.empty(n, 9), torch.empty(n, 3)
        box, visible = torch.zeros(n, 4, dtype=torch.int32), torch.zeros(n, dtype=torch.bool)
        args = [_numpy(x) for x in (mu, quat, log_scale, opacity, R, t)]
        p = [np.float32(v) for v in (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)]
        outs = [x.numpy() for x in (geo, box, visible, normal)]
        run_chunks(lambda lo, hi: _forward(lo, hi, *args, *p, pinhole.width, pinhole.height, cull, *outs), n, 2, 2048)
        ctx.save_for_backward(mu, quat, log_scale, R, t, geo, visible)
        ctx.pinhole = pinhole
        ctx.mark_non_differentiable(box, visible)
        return geo, normal, box, visible

    @staticmethod
    def backward(ctx: Any, g_geo: Tensor, g_normal: Tensor, _box: Any, _visible: Any) -> Any:
        """Chain the screen and normal gradients to surfels and pose."""
        mu, quat, log_scale, R, t, geo, visible = ctx.saved_tensors
        n = mu.shape[0]
        g_mu, g_quat, g_scale = torch.empty(n, 3), torch.empty(n, 4), torch.empty(n, 2)
        args = [_numpy(x) for x in (mu, quat, log_scale, R, t)]
        fx, fy = np.float32(ctx.pinhole.fx), np.float32(ctx.pinhole.fy)
        rest = [_numpy(x) for x in (visible, geo, g_geo, g_normal)]
        outs = [x.numpy() for x in (g_mu, g_quat, g_scale)]
        step = 4096  # fixed chunks: the pose sum does not depend on the number of threads
        poses = np.zeros((max(1, -(-n // step)), 12), np.float32)

        def work(lo: int, hi: int) -> None:
            for c in range(lo, hi):
                _backward(c * step, min(n, (c + 1) * step), *args, fx, fy, *rest, *outs, poses[c])

        run_chunks(work, -(-n // step), 2)
        pose = torch.from_numpy(poses.sum(0, dtype=np.float64).astype(np.float32))
        return g_mu, g_quat, g_scale, None, pose[:9].view(3, 3), pose[9:], None, None
