"""Blending as one autograd function around the Triton kernels: the twin of the Numba one in `gsbake.surfels.raster.rasterise`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsbake.surfels.raster.cuda import kernels
from gsbake.surfels.raster.cuda.binning import bin_surfels
from gsbake.surfels.raster.kernel import AUX_PLANES, FEATURE_OFFSET


class Blend(torch.autograd.Function):
    """`apply(geo, opacity, features, box, visible, width, height, stats)` → planes (c + 6, h, w), see `gsbake.surfels.raster.kernel`.

    Tensors lie on a CUDA device; on the CPU when Triton interprets (TRITON_INTERPRET=1). Σ w per surfel goes to stats["weight"] in
    backward.
    """

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
        """Bin and blend; see the class."""
        c = features.shape[1]
        g, o, f = (x.detach().contiguous() for x in (geo, opacity, features))
        bins = bin_surfels(g[:, 8], box, visible, width, height)
        out = torch.empty(c + AUX_PLANES, height, width, device=geo.device)
        tiles = len(bins.starts) - 1
        used = torch.empty(tiles, dtype=torch.int64, device=geo.device)
        padded = max(16, 1 << (c - 1).bit_length())
        kernels.forward[(tiles,)](
            bins.starts, bins.ids, g, o, f, out, used, bins.tiles_x, width, height, C=c, CP=padded, **kernels.FORWARD
        )  # fmt: skip
        ctx.save_for_backward(g, o, f, out)
        ctx.bins, ctx.used, ctx.stats = bins, used, stats
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        """One gradient row per (tile, surfel) pair, then each surfel's rows are added in their order: no atomics."""
        geo, opacity, features, out = ctx.saved_tensors
        bins, (n, c) = ctx.bins, features.shape
        planes = torch.cat([grad[: c + 2], grad[c + 4 : c + 5]]).contiguous()
        rows = torch.zeros(len(bins.ids), FEATURE_OFFSET + c, device=geo.device)  # rows behind a full tile stay zero
        kernels.backward[(len(bins.starts) - 1,)](
            bins.starts, bins.ids, bins.slots, geo, opacity, features, out, ctx.used, planes, rows,
            bins.tiles_x, out.shape[2], out.shape[1], C=c, **kernels.BACKWARD,
        )  # fmt: skip
        sums = torch.zeros(n, FEATURE_OFFSET + c, device=geo.device)
        if len(bins.front):
            sums[bins.front] = torch.segment_reduce(rows, "sum", lengths=bins.counts, axis=0, unsafe=True, initial=0)
        ctx.stats["weight"] = sums[:, 10]
        return sums[:, :9].contiguous(), sums[:, 9].contiguous(), sums[:, FEATURE_OFFSET:].contiguous(), None, None, None, None, None
