"""The rasteriser's readable twin: plain PyTorch, any dtype, one surfel after the other over whole images.

Formulas as in `projection` and `kernel` (2DGS, Huang et al. 2024); gradients by autograd. Slow: for tests and for reading.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.raster.kernel import ALPHA_MAX, ALPHA_MIN, NDC_SCALE, TRANSMITTANCE_MIN
from gsbake.surfels.raster.projection import EDGE_ON_COS, Pinhole


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4) as (w, x, y, z), normalised here."""
    w, x, y, z = (quaternion / quaternion.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        1,
    ).view(-1, 3, 3)  # fmt: skip


def render_reference(
    position: Tensor,
    quaternion: Tensor,
    log_scale: Tensor,
    opacity: Tensor,
    features: Tensor,
    rotation: Tensor,
    translation: Tensor,
    pinhole: Pinhole,
    near: float = 0.02,
    cull_backfaces: bool = False,
) -> dict[str, Tensor]:
    """Same inputs as `raster.render`; returns planes "features" (c, h, w), "depth", "distortion", "alpha", "median" (h, w)."""
    dtype = position.dtype
    x = torch.arange(pinhole.width, dtype=dtype) + 0.5
    y = torch.arange(pinhole.height, dtype=dtype)[:, None] + 0.5
    shape = (pinhole.height, pinhole.width)
    transmittance = torch.ones(shape, dtype=dtype)
    out = torch.zeros(features.shape[1], *shape, dtype=dtype)
    depth, distortion, b1, b2, median = (torch.zeros(shape, dtype=dtype) for _ in range(5))
    axes = rotation @ rotation_matrix(quaternion)
    centre = position @ rotation.T + translation
    for i in torch.argsort(centre[:, 2].detach(), stable=True).tolist():
        c, (t, b, n) = centre[i], axes[i].unbind(1)
        h = n @ c
        if not (c[2] > near and opacity[i] > ALPHA_MIN and abs(h) > EDGE_ON_COS * c.norm()) or (cull_backfaces and h > 0):
            continue
        su, sv = log_scale[i].exp().unbind()
        dx = x - (pinhole.fx * c[0] / c[2] + pinhole.cx)
        dy = y - (pinhole.fy * c[1] / c[2] + pinhole.cy)
        # the pixel's ray is c/c_z + (dx/fx, dy/fy, 0): intersect it with the plane n·(p − c) = 0
        rx, ry = c[0] / c[2] + dx / pinhole.fx, c[1] / c[2] + dy / pinhole.fy
        facing = n[0] * rx + n[1] * ry + n[2]
        ahead = (facing * c[2] / h) > 1e-4
        z_hit = h / torch.where(ahead, facing, h)
        px, py, pz = z_hit * rx - c[0], z_hit * ry - c[1], z_hit - c[2]
        u, v = (px * t[0] + py * t[1] + pz * t[2]) / su, (px * b[0] + py * b[1] + pz * b[2]) / sv
        r3 = torch.where(ahead, u * u + v * v, torch.full_like(u, 1e8))
        r2 = 2 * (dx * dx + dy * dy)
        plane = r3 <= r2
        z = torch.where(plane, z_hit, c[2].expand(shape))
        alpha = (opacity[i] * torch.exp(-torch.where(plane, r3, r2).clamp_max(16) / 2)).clamp_max(ALPHA_MAX)
        on = (alpha >= ALPHA_MIN) & (transmittance >= TRANSMITTANCE_MIN)
        alpha = torch.where(on, alpha, torch.zeros_like(alpha))
        w = alpha * transmittance
        m = -NDC_SCALE / z
        accumulated = 1 - transmittance
        distortion = distortion + w * (m * m * accumulated + b2 - 2 * m * b1)
        b1, b2 = b1 + w * m, b2 + w * m * m
        out = out + w * features[i][:, None, None]
        depth = depth + w * z
        after = transmittance * (1 - alpha)
        median = torch.where((transmittance > 0.5) & (after <= 0.5), z.detach(), median)
        transmittance = after
    return {"features": out, "depth": depth, "distortion": distortion, "alpha": 1 - transmittance, "median": median}
