"""The training losses, each a plain function of rendered planes (weights live in the profile's [loss] section).

Colour as 3DGS (L1 and SSIM); median sharpness and projection as Zhu et al. 2025 (DSDF); normal consistency and distortion as 2DGS
(Huang et al. 2024).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.raster.kernel import AUX_PLANES
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import expected_depth
from gsbake.surfels.transfer import Transfer
from gsbake.surfels.views import TrainView

#: Projection errors above this (unit frame) are other surfaces, not error.
PROJECTION_ERROR_MAX = 0.1


@dataclass(frozen=True)
class ImageWeights:
    """Weights of the losses of one photo; `ssim` is the share of 1 − SSIM in the colour loss, whose weight is 1."""

    ssim: float
    normal: float = 0.0
    mask: float = 0.0
    distortion: float = 0.0
    smoothness: float = 0.0


@lru_cache(maxsize=4)
def _window(channels: int, size: int = 11, sigma: float = 1.5) -> tuple[Tensor, Tensor]:
    x = torch.arange(size, dtype=torch.float32) - size // 2
    g = torch.exp(-(x * x) / (2 * sigma * sigma))
    g = (g / g.sum()).expand(channels, 1, 1, size).contiguous()
    return g, g.transpose(2, 3).contiguous()


def _blur(x: Tensor) -> Tensor:
    """Gaussian window of SSIM (11 taps, σ 1.5) on planes (c, h, w), zeros outside."""
    row, column = _window(x.shape[0])
    return F.conv2d(F.conv2d(x[None], row.to(x), padding=(0, 5), groups=x.shape[0]), column.to(x), padding=(5, 0), groups=x.shape[0])[0]


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of images (c, h, w) in 0..1 (Wang et al. 2004: K1 = .01, K2 = .03)."""
    c = a.shape[0]
    mean = _blur(torch.cat([a, b, a * a, b * b, a * b]))
    ma, mb, aa, bb, ab = mean.split(c)
    va, vb, cov = aa - ma * ma, bb - mb * mb, ab - ma * mb
    return (((2 * ma * mb + 1e-4) * (2 * cov + 9e-4)) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))).mean()


def colour_loss(image: Tensor, target: Tensor, ssim_share: float) -> Tensor:
    """(1 − λ) L1 + λ (1 − SSIM) of sRGB images (3, h, w)."""
    loss = (1 - ssim_share) * (image - target).abs().mean()
    return loss + ssim_share * (1 - ssim(image, target)) if ssim_share else loss


def median_sharpness(sdf: Tensor, gamma: Tensor, transfer: Transfer, widths: tuple[float, float] | None = None) -> Tensor:
    """relu(target(median |s|) − γ); the median is detached.

    The target is the transfer's, with its constants in the unit frame; or, given the least and largest of the `widths` (unit frame), half
    the peak at the median held between them.
    """
    median = float(sdf.detach().abs().median()) if len(sdf) else 1.0
    if widths is not None:
        return F.relu(transfer.half_width(0.5) / min(max(median, widths[0]), widths[1]) - gamma).sum()
    return F.relu(transfer.target_sharpness(max(median, 1e-6)) - gamma).sum()


def projection_loss(
    position: Tensor, normal: Tensor, sdf: Tensor, visible: Tensor, depth: Tensor, alpha: Tensor, R: Tensor, t: Tensor, view: Pinhole
) -> Tensor:
    """Mean |D(uv(μ')) − z(μ')| over visible surfels with μ' = μ − s n inside the frame and errors below `PROJECTION_RANGE`.

    D is the expected depth of the blended planes `depth` and `alpha` (h, w); these and the pose (R, t) get no gradient.
    """
    R, t, surface = R.detach(), t.detach(), expected_depth(depth, alpha).detach()
    index = visible.nonzero()[:, 0]
    if not len(index):
        return sdf.sum() * 0
    moved = position[index] - sdf[index, None] * normal[index]
    cam = moved @ R.T + t
    z = cam[:, 2].clamp_min(1e-3)
    x = (view.fx * cam[:, 0] / z + view.cx) / view.width * 2 - 1
    y = (view.fy * cam[:, 1] / z + view.cy) / view.height * 2 - 1
    grid = torch.stack([x, y], 1).detach()[None, None]
    planes = torch.stack([surface, (surface > 0).to(surface)])[None]
    seen = F.grid_sample(planes, grid, mode="bilinear", padding_mode="zeros", align_corners=False)[0, :, 0]
    # along the pixel's ray only z moves: the gradient through uv is left out, it chases depth edges
    error = (seen[0] - z).abs()
    ok = (seen[1] > 0.999) & (error < PROJECTION_ERROR_MAX)
    return (error * ok).sum() / ok.sum().clamp_min(1)


def silhouette_distance(points: Tensor, distance: Tensor, R: Tensor, t: Tensor, view: Pinhole) -> Tensor:
    """Mean distance (unit frame) by which points (n, 3) project outside the mask; 0 for those behind the camera or not finite.

    `distance` (h, w) is in pixels from each pixel to the mask, 0 inside. It is 0 in all views for points of the visual hull alone
    (Laurentini, *The visual hull concept*, PAMI 1994). The gradient moves points across the view, towards the mask; the depth that turns
    pixels into lengths, and the pose, get none. Points outside the frame are taken at its border.
    """
    cam = points @ R.detach().T + t.detach()
    known = torch.isfinite(cam).all(1) & (cam[:, 2] > 1e-3) & (cam[:, :2].abs() < 1e4 * cam[:, 2:]).all(1)
    cam = torch.where(known[:, None], cam, 1.0)
    z = cam[:, 2]
    x = (view.fx * cam[:, 0] / z + view.cx) / view.width * 2 - 1
    y = (view.fy * cam[:, 1] / z + view.cy) / view.height * 2 - 1
    grid = torch.stack([x, y], 1)[None, None]
    pixels = F.grid_sample(distance[None, None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0, 0, 0]
    return torch.where(known, pixels * (z.detach() / view.fx), 0.0).sum() / max(1, len(points))


def depth_normals(depth: Tensor, R: Tensor, view: Pinhole) -> Tensor:
    """World normals (3, h, w) of a z-depth map (h, w) by central differences of back-projected pixels, facing the camera; zero at the
    frame."""
    x = (torch.arange(view.width, dtype=depth.dtype, device=depth.device) + 0.5 - view.cx) / view.fx
    y = (torch.arange(view.height, dtype=depth.dtype, device=depth.device) + 0.5 - view.cy) / view.fy
    p = torch.stack([depth * x, depth * y[:, None], depth])
    du = p[:, 1:-1, 2:] - p[:, 1:-1, :-2]
    dv = p[:, 2:, 1:-1] - p[:, :-2, 1:-1]
    n = F.normalize(torch.linalg.cross(dv, du, dim=0), dim=0, eps=1e-12)
    return F.pad(torch.einsum("ij,ihw->jhw", R, n), (1, 1, 1, 1))


def normal_consistency(normals: Tensor, alpha: Tensor, from_depth: Tensor, mask: Tensor) -> Tensor:
    """Mean over `mask` of (Σw − Σw n · n_depth): blended world normals (3, h, w) against the depth map's."""
    return ((alpha - (normals * from_depth).sum(0)) * mask).sum() / mask.sum().clamp_min(1)


def mask_entropy(alpha: Tensor, mask: Tensor) -> Tensor:
    """Binary cross-entropy of alpha (h, w) against the mask in 0..1."""
    return F.binary_cross_entropy(alpha.clamp(1e-6, 1 - 1e-6), mask)


def smoothness_loss(planes: Tensor, guide: Tensor, mask: Tensor) -> Tensor:
    """Edge-aware smoothness of (c, h, w) planes: mean |∇planes| · exp(−10 |∇grey|) inside the mask (h, w); guide (h, w) is the
    photo's grey."""
    loss = planes.new_zeros(())
    for axis in (1, 2):
        d = planes.diff(dim=axis).abs().mean(0)
        g = guide.diff(dim=axis - 1).abs()
        m = mask[1:] * mask[:-1] if axis == 1 else mask[:, 1:] * mask[:, :-1]
        loss = loss + (d * torch.exp(-10 * g) * m).sum() / m.sum().clamp_min(1)
    return loss


def image_losses(
    planes: Tensor, picture: Tensor, view: TrainView, masked: bool, background: Tensor, weights: ImageWeights, materials: bool
) -> tuple[Tensor, Tensor]:
    """Weighted sum of what one photo asks of its render, and the colour loss alone (both scalars).

    `planes` (c + 6, h, w) as blended, the world normals the last of the c features; `picture` (3, h, w) the premultiplied sRGB picture. It
    is composited over `background` (3,), like the photo where `masked`; else the photo is taken as it is, there is no mask loss, and
    pixels with alpha above ½ count as inside. With `materials` the features before the normals are smoothed.
    """
    channels = planes.shape[0] - AUX_PLANES
    depth, alpha = planes[channels], planes[channels + 4]
    photo, cover, back = view.colour().to(planes.dtype), view.cover() if masked else None, background[:, None, None]
    cover = None if cover is None else cover.to(planes.dtype)
    target = photo if cover is None else photo * cover + back * (1 - cover)
    first = colour_loss(picture + back * (1 - alpha), target, weights.ssim)
    total = first
    inside = ((alpha.detach() if cover is None else cover) > 0.5).to(planes.dtype)
    if weights.normal:
        normals = depth_normals(expected_depth(depth, alpha), view.R.to(planes.dtype), view.pinhole)
        total = total + weights.normal * normal_consistency(planes[channels - 3 : channels], alpha, normals, inside)
    if cover is not None and weights.mask:
        total = total + weights.mask * mask_entropy(alpha, cover)
    if weights.distortion:
        total = total + weights.distortion * planes[channels + 1].mean()
    if materials and weights.smoothness:
        total = total + weights.smoothness * smoothness_loss(planes[: channels - 3], photo.mean(0), inside)
    return total, first
