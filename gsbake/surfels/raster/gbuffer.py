"""From blended planes to a picture: G-buffers, and deferred shading with the environment light (METHOD "shading").

Planes are divided by alpha, shaded where alpha > 1/255, turned to sRGB and composited.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.kernel import AUX_PLANES
from gsbake.surfels.raster.rasterise import Rendered, render
from gsbake.surfels.training.views import TrainView

if TYPE_CHECKING:
    from gsbake.shading.light_tables import LightTables

SHADING_ALPHA_MIN = 1.0 / 255.0


def rasterise(surfels: Surfels, view: TrainView, cull_backfaces: bool = False, opacity: Tensor | None = None) -> Rendered:
    """Blend all features of the surfels (their own, then the world normals) in one view; `opacity` (n,) replaces the surfels'."""
    opacity = surfels.opacity() if opacity is None else opacity
    return render(
        surfels.position, surfels.quaternion, surfels.log_scale, opacity, surfels.features(view.centre),
        view.R, view.t, view.pinhole, cull_backfaces=cull_backfaces,
    )  # fmt: skip


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
