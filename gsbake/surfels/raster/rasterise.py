"""Differentiable rasterisation of surfels: sort, bin and blend around the Numba kernel, as one autograd function.

`render` is the one entry the rest of gsbake uses; `gsbake.surfels.raster.reference` is its readable twin. Tensors on a GPU go to
`gsbake.surfels.raster.cuda`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsbake.kernels.threads import run_chunks
from gsbake.surfels.raster.binning import bin_surfels
from gsbake.surfels.raster.kernel import AUX_PLANES, FEATURE_OFFSET, backward_kernel, forward_kernel, sum_slots
from gsbake.surfels.raster.projection import Pinhole, Project


def expected_depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Alpha-normalised z-depth of Σ w z and Σ w (h, w); 0 where nothing is."""
    return torch.where(alpha > 1e-3, depth / alpha.clamp_min(1e-3), torch.zeros_like(depth))


@dataclass
class Rendered:
    """One rendered view. Planes are (h, w) or (c, h, w) float32; sums over surfels are weighted by w = α T, not divided by alpha.

    `features` (c, h, w); `depth` Σ w z; `distortion` Σ_{i<j} w_i w_j (m_i − m_j)² on NDC depth; `alpha` Σ w; `median` depth where T
    crosses ½ (0 if it never does; no gradient); `normal` (n, 3) world normals of the surfels; `visible` (n,) bool;
    `projected` (n, 9), whose `.grad` after backward holds the screen-space gradients (columns 0, 1: the centre, in pixels);
    `stats["weight"]` holds Σ w per surfel after backward. `planes` (c + 6, h, w) is what all of them are cut from.
    """

    planes: Tensor
    features: Tensor
    depth: Tensor
    distortion: Tensor
    alpha: Tensor
    median: Tensor
    normal: Tensor
    visible: Tensor
    projected: Tensor
    stats: dict[str, Tensor]

    def expected_depth(self) -> Tensor:
        """Alpha-normalised expected z-depth (h, w); 0 where nothing is."""
        return expected_depth(self.depth, self.alpha)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        geo: Tensor,
        opacity: Tensor,
        features: Tensor,
        box: Tensor,
        visible: Tensor,
        width: int,
        height: int,
        stats: dict[str, Tensor],
    ) -> Tensor:
        channels = features.shape[1]
        g, o, f = (x.detach().contiguous().numpy() for x in (geo, opacity, features))
        b = box.numpy()
        bins = bin_surfels(np.ascontiguousarray(g[:, 8]), b, visible.numpy(), width, height)
        out = torch.empty(channels + AUX_PLANES, height, width)
        used = np.empty(len(bins.order), np.int64)
        kernel, image = forward_kernel(channels), out.numpy()
        run_chunks(
            lambda lo, hi: kernel(bins.order, lo, hi, bins.starts, bins.ids, g, b, o, f, width, height, bins.tiles_x, image, used),
            len(bins.order),
        )
        ctx.save_for_backward(geo, opacity, features, box, out)
        ctx.bins, ctx.used, ctx.size, ctx.stats = bins, used, (width, height), stats
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        geo, opacity, features, box, out = ctx.saved_tensors
        bins, used, (width, height) = ctx.bins, ctx.used, ctx.size
        channels, n = features.shape[1], features.shape[0]
        g, o, f = (x.detach().contiguous().numpy() for x in (geo, opacity, features))
        planes = grad.contiguous().numpy()
        result = np.empty((len(bins.ids), FEATURE_OFFSET + channels), np.float32)
        kernel, image, b = backward_kernel(channels), out.numpy(), box.numpy()
        run_chunks(
            lambda lo, hi: kernel(
                bins.order, lo, hi, bins.starts, bins.ids, bins.slots, g, b, o, f, width, height, bins.tiles_x, image, used, planes, result
            ),
            len(bins.order),
        )
        sums = torch.empty(n, FEATURE_OFFSET + channels)
        total = sums.numpy()
        run_chunks(lambda lo, hi: sum_slots(lo, hi, bins.offsets, result, total), n, 2, 4096)
        ctx.stats["weight"] = sums[:, 10]
        return sums[:, :9].contiguous(), sums[:, 9].contiguous(), sums[:, FEATURE_OFFSET:].contiguous(), None, None, None, None, None


def render(
    position: Tensor,
    quaternion: Tensor,
    log_scale: Tensor,
    opacity: Tensor,
    features: Tensor,
    rotation: Tensor,
    translation: Tensor,
    pinhole: Pinhole,
    normals_as_features: bool = True,
    cull_backfaces: bool = False,
    triton: bool | None = None,
) -> Rendered:
    """Render surfels: position (n, 3), quaternion (n, 4) as (w, x, y, z), log_scale (n, 2), opacity (n,), features (n, c); float32, all
    on one device.

    `rotation` (3, 3) and `translation` (3,) are world→camera (OpenCV axes); gradients flow to them too. With `normals_as_features`
    the world normals are blended as three more channels behind the given ones. `triton` chooses the kernels: by default the GPU's for
    tensors on a GPU; they take tensors on the CPU only where Triton interprets (TRITON_INTERPRET=1).
    """
    blend: Any = _Blend.apply
    project: Any = Project.apply
    if position.is_cuda if triton is None else triton:
        from gsbake.surfels.raster.cuda.blend import Blend
        from gsbake.surfels.raster.cuda.projection import project

        blend = Blend.apply
    geo, normal, box, visible = project(position, quaternion, log_scale, opacity, rotation, translation, pinhole, cull_backfaces)
    if geo.requires_grad:
        geo.retain_grad()
    if normals_as_features:
        features = torch.cat([features, normal], 1)
    stats: dict[str, Tensor] = {}
    out = blend(geo, opacity, features, box, visible, pinhole.width, pinhole.height, stats)
    c = features.shape[1]
    # One split: taking the planes out one by one costs autograd a zero-filled copy of all of them each.
    blended, depth, distortion, _, alpha, median = out.split([c, 1, 1, 2, 1, 1])
    return Rendered(out, blended, depth[0], distortion[0], alpha[0], median[0].detach(), normal, visible, geo, stats)
