"""The losses of one rendered photo as one autograd function: forward computes value and gradients, backward hands them out.

In torch these are some hundred small operations on planes. The passes are `deferred_shading`, `photometric` (colour), `geometry` (normals,
mask, distortion) and `smoothness` (materials). The twin, which runs on a GPU, is `terms.image_losses` of `gbuffer.rendered_image`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsbake.shading.light_tables import LightTables
from gsbake.surfels.gbuffer import rendered_image
from gsbake.surfels.losses import geometry, photometric, smoothness
from gsbake.surfels.losses import terms as losses
from gsbake.surfels.losses.deferred_shading import DeferredShading
from gsbake.surfels.losses.terms import ImageWeights
from gsbake.surfels.raster.kernel import AUX_PLANES
from gsbake.surfels.views import TrainView


class _ImageLosses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, planes: Tensor, table: Tensor | None, tables: LightTables | None, view: TrainView, masked: bool, background: Tensor,
        weights: ImageWeights,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        p = planes.detach().contiguous()
        channels, (h, w) = p.shape[0] - AUX_PLANES, p.shape[1:]
        size, lens = h * w, view.pinhole
        grad = torch.empty_like(p)
        flat, g, alpha = p.view(-1).numpy(), grad.view(-1).numpy(), p[channels + 4].numpy()
        rgb, back = view.rgb.contiguous().view(-1).numpy(), background.contiguous().numpy()
        mask = view.mask.contiguous().numpy() if masked and view.mask is not None else np.full((h, w), 255, np.uint8)
        shaded = None if tables is None else DeferredShading(p.numpy(), view, tables)
        picture, g_picture = (flat, g) if shaded is None else (shaded.picture.reshape(-1), np.empty(3 * size, np.float32))
        colour = photometric.colour_loss(picture, alpha.reshape(-1), rgb, mask.reshape(-1), back, h, w, weights.ssim, g_picture)
        inside = mask > 127 if masked else alpha > 0.5
        per = (weights.normal / max(1, int(np.count_nonzero(inside))), weights.mask / size if masked else 0.0, weights.distortion / size)
        camera, rot = np.array([lens.fx, lens.fy, lens.cx, lens.cy], np.float32), view.R.detach().contiguous().numpy()
        sums = geometry.geometry_losses(flat, channels, h, w, mask.reshape(-1), masked, g_picture, back, rot, camera, per, g)
        total = colour + sum(a * b for a, b in zip(per, sums, strict=True) if a)
        g_table = None
        if shaded is not None:
            # the materials' planes: written by the smoothness, added to by the shading
            if weights.smoothness:
                total += smoothness.smoothness_loss(flat, channels - 3, h, w, rgb, inside, weights.smoothness, g)
            else:
                grad[: channels - 3].zero_()
            g_table = torch.from_numpy(shaded.backward(g_picture.reshape(3, size), g.reshape(-1, size)))
        ctx.save_for_backward(grad, g_table)
        return torch.tensor(total, dtype=torch.float32), torch.tensor(colour, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor, _colour: Tensor) -> Any:
        grads = ctx.saved_tensors
        if float(upstream) != 1.0:
            grads = tuple(g if g is None else g * upstream for g in grads)
        return *grads, None, None, None, None, None


def image_losses(
    planes: Tensor, tables: LightTables | None, view: TrainView, masked: bool, background: Tensor, weights: ImageWeights
) -> tuple[Tensor, Tensor]:
    """`terms.image_losses` of `gbuffer.rendered_image` in one pass on the CPU; on a GPU these two functions themselves.

    Gradients to the planes and to the light's table; the colour loss, which comes second, carries none on the CPU.
    """
    if planes.is_cuda:
        return losses.image_losses(planes, rendered_image(planes, view, tables), view, masked, background, weights, tables is not None)
    total, colour = _ImageLosses.apply(planes, None if tables is None else tables.table, tables, view, masked, background, weights)
    return total, colour.detach()
