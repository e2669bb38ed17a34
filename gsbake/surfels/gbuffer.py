"""From blended planes to a picture: G-buffers, and deferred shading with the environment light (METHOD "shading").

Planes are divided by alpha, shaded where alpha > 1/255, turned to sRGB and composited.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.kernel import AUX_PLANES
from gsbake.surfels.raster.rasterise import Rendered, render
from gsbake.surfels.views import TrainView

if TYPE_CHECKING:
    from gsbake.shading.light_tables import LightTables

SHADING_ALPHA_MIN = 1.0 / 255.0
#: Minimum |n·d| of a surfel whose depth is shifted: seen edge-on the shift has no bound.
MIN_SLANT = 0.2


def rasterise(
    surfels: Surfels, view: TrainView, cull_backfaces: bool = False, opacity: Tensor | None = None, distance: Tensor | None = None
) -> Rendered:
    """Blend all features of the surfels (their own, then the world normals) in one view; `opacity` (n,) replaces the surfels'.

    With signed distances `distance` (n,) the depth planes are those of the surfels moved by them onto the zero level set: each surfel's
    depth along the ray changes by −s / (n·d), which is blended as one more feature.
    """
    opacity = surfels.opacity() if opacity is None else opacity
    features = surfels.features(view.centre)
    if distance is not None:
        features = torch.cat([features, depth_shift(surfels, view, distance)[:, None]], 1)
    out = render(
        surfels.position, surfels.quaternion, surfels.log_scale, opacity, features, view.R, view.t, view.pinhole,
        cull_backfaces=cull_backfaces,
    )  # fmt: skip
    return out if distance is None else _with_shifted_depth(out)


def depth_shift(surfels: Surfels, view: TrainView, distance: Tensor) -> Tensor:
    """Change of depth (n,) along the ray to each surfel's centre when its plane moves by −`distance` (n,) along its normal. Gradient to the
    distance alone."""
    with torch.no_grad():
        camera = surfels.position @ view.R.T + view.t
        slant = ((surfels.normal() @ view.R.T) * camera).sum(1) / camera[:, 2].clamp_min(1e-3)
        slant = torch.where(slant < 0, slant.clamp_max(-MIN_SLANT), slant.clamp_min(MIN_SLANT))
    return -distance / slant


def _with_shifted_depth(out: Rendered) -> Rendered:
    """The render without its last feature before the normals, which is added to the depths."""
    c = out.planes.shape[0] - AUX_PLANES
    own, shift, normals, depth, rest = out.planes.split([c - 4, 1, 3, 1, AUX_PLANES - 1])
    depth = depth + shift
    features = torch.cat([own, normals])
    median = torch.where(out.median > 0, out.median + (shift[0] / out.alpha.clamp_min(1e-3)).detach(), out.median)
    return replace(out, planes=torch.cat([features, depth, rest]), features=features, depth=depth[0], median=median)


def view_directions(view: TrainView, index: Tensor) -> Tensor:
    """Unit vectors (n, 3) from the surface to the camera at the flat pixel indices (n,), in the unit frame."""
    p = view.pinhole
    x = ((index % p.width).to(view.R) + 0.5 - p.cx) / p.fx
    y = ((index // p.width).to(view.R) + 0.5 - p.cy) / p.fy
    z = torch.rsqrt(x * x + y * y + 1)
    return torch.stack([-x * z, -y * z, -z], 1) @ view.R


def rendered_image(planes: Tensor, view: TrainView, tables: LightTables | None) -> Tensor:
    """Premultiplied sRGB picture (3, h, w) of blended planes (c + 6, h, w): their colours, or with light tables the shaded G-buffers.
    `gsbake.surfels.losses.deferred_shading` is its twin in training."""
    if tables is None:
        return planes[:3]
    from gsbake.imaging.srgb_torch import linear_to_srgb
    from gsbake.shading.split_sum import shade

    h, w = planes.shape[1:]
    flat = planes.reshape(len(planes), -1)
    over = flat[len(planes) - AUX_PLANES + 4]
    index = (over.detach() > SHADING_ALPHA_MIN).nonzero()[:, 0]
    alpha = over[index]
    g = (flat[:, index] / alpha.clamp_min(SHADING_ALPHA_MIN)).T
    normal = g[:, 5:8] * torch.rsqrt((g[:, 5:8] ** 2).sum(1, keepdim=True).clamp_min(1e-12))
    rgb = shade(normal, view_directions(view, index), g[:, :3], g[:, 3], g[:, 4], tables)
    image = planes.new_zeros(h * w, 3).index_copy(0, index, linear_to_srgb(rgb) * alpha[:, None])
    return image.T.reshape(3, h, w)
