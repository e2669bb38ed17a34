"""From surfels in the world to nine screen numbers each, in torch operations on any device: the twin of `gsbake.surfels.raster.projection`.

Formulas and thresholds as there; gradients by autograd. A surfel that is behind, edge-on, faint or off the screen is replaced by a
harmless one before anything is divided, so that no NaN reaches the gradients of the others.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsbake.surfels.raster.kernel import ALPHA_MIN
from gsbake.surfels.raster.projection import COEF_MAX, EDGE_ON_COS, NEAR_Z, QUATERNION_MIN, SCALE_MAX, SCALE_MIN, Pinhole
from gsbake.surfels.raster.reference import rotation_matrix

#: The whole screen, as the box of a disc that reaches the camera's plane.
_UNBOUNDED = 1e9
_LOG_SCALE_MIN = math.log(SCALE_MIN)


def project(
    mu: Tensor, quat: Tensor, log_scale: Tensor, opacity: Tensor, R: Tensor, t: Tensor, pinhole: Pinhole, cull: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`geo` (n, 9), world `normal` (n, 3), `box` (n, 4) int32, `visible` (n,), as `gsbake.surfels.raster.projection.Project` gives them."""
    fx, fy = pinhole.fx, pinhole.fy
    some = (quat * quat).sum(1, keepdim=True) > float(QUATERNION_MIN)
    turned = rotation_matrix(torch.where(some, quat, quat.new_tensor([1.0, 0.0, 0.0, 0.0])))
    axes = R @ turned
    tangent, bitangent = axes[:, :, 0], axes[:, :, 1]
    normal = torch.linalg.cross(tangent, bitangent, dim=1)
    centre = mu @ R.T + t
    h = (normal * centre).sum(1)
    with torch.no_grad():
        ok = (centre[:, 2] > float(NEAR_Z)) & (opacity > ALPHA_MIN) & (h.abs() > EDGE_ON_COS * centre.norm(dim=1))
        ok &= torch.isfinite(centre).all(1) & (log_scale.exp() < float(SCALE_MAX)).all(1)
        if cull:
            ok &= h <= 0
    c = torch.where(ok[:, None], centre, centre.new_tensor([0.0, 0.0, 1.0]))
    h = torch.where(ok, h, torch.ones_like(h))
    log_scale = torch.where(ok[:, None], log_scale, torch.zeros_like(log_scale))
    z = c[:, 2]
    k = z / h
    focal = c.new_tensor([fx, fy])
    limit = float(COEF_MAX)
    # the clamp stands before the exponential: behind it, 0 · inf would be the gradient
    ku, kv = (k[:, None] * torch.exp(-log_scale.clamp_min(_LOG_SCALE_MIN))).unbind(1)
    u = (ku[:, None] * torch.linalg.cross(bitangent, c, dim=1)[:, :2] / focal).clamp(-limit, limit)
    v = (kv[:, None] * torch.linalg.cross(c, tangent, dim=1)[:, :2] / focal).clamp(-limit, limit)
    w = k[:, None] * normal[:, :2] / focal
    screen = focal * c[:, :2] / z[:, None] + c.new_tensor([pinhole.cx, pinhole.cy])
    geo = torch.cat([screen, u, v, w, z[:, None]], 1)
    with torch.no_grad():
        scale = log_scale.exp()
        box, seen = _boxes(c, tangent * scale[:, :1], bitangent * scale[:, 1:], opacity, screen, pinhole)
        visible = ok & seen
    return torch.where(visible[:, None], geo, torch.zeros_like(geo)), turned[:, :, 2], torch.where(visible[:, None], box, 0), visible


def _boxes(c: Tensor, a: Tensor, b: Tensor, opacity: Tensor, screen: Tensor, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
    """Inclusive pixel boxes (n, 4) int32 of discs with scaled axes a and b at c, joined with the low-pass disc, and which hold a pixel."""
    r2 = (2 * torch.log(255 * opacity))[:, None]
    cz, az, bz = c[:, 2:], a[:, 2:], b[:, 2:]
    lead = cz * cz - r2 * (az * az + bz * bz)
    bounded = lead > 1e-6 * cz * cz
    lead = torch.where(bounded, lead, torch.ones_like(lead))
    xy, ax, bx = c[:, :2], a[:, :2], b[:, :2]
    mid = (xy * cz - r2 * (ax * az + bx * bz)) / lead
    half = (mid * mid - (xy * xy - r2 * (ax * ax + bx * bx)) / lead).clamp_min(0).sqrt()
    focal, principal = c.new_tensor([pinhole.fx, pinhole.fy]), c.new_tensor([pinhole.cx, pinhole.cy])
    size = c.new_tensor([pinhole.width, pinhole.height])
    low = (0.5 * r2).clamp_min(0).sqrt()
    lower = torch.minimum(torch.where(bounded, focal * (mid - half) + principal, -_UNBOUNDED), screen - low) - 0.5
    upper = torch.maximum(torch.where(bounded, focal * (mid + half) + principal, _UNBOUNDED), screen + low) - 0.5
    # pixels whose centre j + .5 lies between; positive form, so that NaN is skipped
    seen = ((upper >= 0) & (lower <= size - 1)).all(1)
    inside = seen[:, None]
    first = torch.where(inside, lower, 0.0).clamp_min(0).ceil().int()
    last = torch.minimum(torch.where(inside, upper, 0.0), size - 1).floor().int()
    return torch.stack([first[:, 0], last[:, 0], first[:, 1], last[:, 1]], 1), seen & (first <= last).all(1)
