"""From blended planes to a picture: G-buffers, and deferred shading with the environment light (METHOD "shading").

Planes are divided by alpha, shaded where alpha > 1/255, turned to sRGB and composited.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsbake.splat.raster import Rendered, render
from gsbake.splat.surfels import Surfels
from gsbake.splat.views import TrainView

if TYPE_CHECKING:
    from gsbake.light.tables import LightTables

ALPHA_SHADED = 1.0 / 255.0


def rasterise(surfels: Surfels, view: TrainView, cull_backfaces: bool = False) -> Rendered:
    """Blend all features of the surfels (their own, then the world normals) in one view."""
    return render(
        surfels.position, surfels.quaternion, surfels.log_scale, surfels.opacity(), surfels.features(view.centre),
        view.R, view.t, view.pinhole, cull_backfaces=cull_backfaces,
    )  # fmt: skip


def view_directions(view: TrainView, index: Tensor) -> Tensor:
    """Unit vectors (n, 3) from the surface to the camera at the flat pixel indices (n,), in the unit frame."""
    p = view.pinhole
    x = (index % p.width + 0.5 - p.cx) / p.fx
    y = (index // p.width + 0.5 - p.cy) / p.fy
    z = torch.rsqrt(x * x + y * y + 1)
    return torch.stack([-x * z, -y * z, -z], 1) @ view.R


def picture(out: Rendered, view: TrainView, tables: LightTables | None) -> Tensor:
    """Premultiplied sRGB picture (3, h, w): blended colours, or with light tables the shaded G-buffers."""
    if tables is None:
        return out.features[:3]
    from gsbake.light.colour import linear_to_srgb
    from gsbake.light.shade import shade

    h, w = out.alpha.shape
    flat = out.features.reshape(out.features.shape[0], -1)
    index = (out.alpha.detach().reshape(-1) > ALPHA_SHADED).nonzero()[:, 0]
    alpha = out.alpha.reshape(-1)[index]
    g = (flat[:, index] / alpha.clamp_min(ALPHA_SHADED)).T
    normal = g[:, 5:8] * torch.rsqrt((g[:, 5:8] ** 2).sum(1, keepdim=True).clamp_min(1e-12))
    rgb = shade(normal, view_directions(view, index), g[:, :3], g[:, 3], g[:, 4], tables)
    image = torch.zeros(h * w, 3, device=alpha.device).index_copy(0, index, linear_to_srgb(rgb) * alpha[:, None])
    return image.T.reshape(3, h, w)
