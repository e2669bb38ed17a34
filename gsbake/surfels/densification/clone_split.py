"""Clone and split under a budget, and pruning by opacity, size, visibility and distance from the surface.

Clone/split after 3DGS (Kerbl et al. 2023); children inherit the SDF sample s (Zhu et al. 2025). Instead of a fixed threshold the surfels
with the highest score of a densification policy are taken, within a budget that grows to `surfels.max_count`: no scene-dependent constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbake.surfels.adam import Adam
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.reference import rotation_matrix

#: Surfels with a lower opacity, as a share of the transfer function's peak, are pruned (discretized SDF: .005, its peak is 1).
MIN_RELATIVE_OPACITY = 0.005
#: Surfels with a lower mean blending weight per view (in pixels) are occluded and pruned.
MIN_VIEW_WEIGHT = 0.05


@dataclass
class Statistics:
    """Per surfel since the last densification: summed screen-space gradient (pixels at unit resolution), number of views that rendered
    it, summed blending weight."""

    gradient: Tensor
    views: Tensor
    weight: Tensor

    @staticmethod
    def zeros(n: int, device: str | torch.device = "cpu") -> Statistics:
        """Empty statistics for n surfels."""
        return Statistics(*(torch.zeros(n, device=device) for _ in range(3)))

    def add(self, screen_grad: Tensor, touched: Tensor, size: int) -> None:
        """Accumulate one backward pass: gradients (n, ≥2) w.r.t. the projected centre in pixels, blending weights `touched` (n,); `size`,
        the image's longer side in pixels, normalises the gradients."""
        visible = touched > 0
        self.gradient += torch.where(visible, torch.hypot(screen_grad[:, 0], screen_grad[:, 1]) * (size / 2), 0.0)
        self.views += visible
        self.weight += touched

    def mean_gradient(self) -> Tensor:
        """Mean screen-space gradient (n,) over the views that rendered each surfel."""
        return self.gradient / self.views.clamp_min(1)


def replace_rows(surfels: Surfels, adam: Adam, keep: Tensor, children: Surfels | None) -> Surfels:
    """Keep the rows at index `keep`, append `children`; Adam's moments follow."""
    names = [k for k in surfels.tensors() if k != "gamma"]
    kept = surfels.select(keep)
    adam.select(names, keep, 0 if children is None else len(children))
    if children is None:
        return kept
    return kept.concat(children)


@torch.no_grad()
def densify(surfels: Surfels, adam: Adam, score: Tensor, budget: int, large: float, generator: torch.Generator) -> Surfels:
    """Split (scale above `large`) or clone the surfels with the highest `score` (n,) > 0 until there are `budget` surfels.

    A split surfel becomes two of 1/1.6 its size, sampled from its Gaussian; a clone is a copy.
    """
    room = budget - len(surfels)
    chosen = torch.argsort(score, descending=True, stable=True)[: max(0, room)]
    chosen = chosen[score[chosen] > 0]
    if not len(chosen):
        return surfels
    parents = surfels.select(chosen)
    split = parents.scale.max(1).values > large
    axes = rotation_matrix(parents.quaternion)[:, :, :2]
    children = []
    for _ in range(2):
        offset = torch.randn(len(chosen), 2, generator=generator).to(score.device).clamp(-2, 2) * parents.scale
        sampled = parents.position + torch.einsum("nij,nj->ni", axes, offset)
        child = parents.select(torch.arange(len(chosen)))
        child.position = torch.where(split[:, None], sampled, parents.position)
        child.log_scale = torch.where(split[:, None], parents.log_scale - math.log(1.6), parents.log_scale)
        children.append(child)
    # the first child replaces its parent and keeps Adam's moments
    surfels.position[chosen] = children[0].position
    surfels.log_scale[chosen] = children[0].log_scale
    return replace_rows(surfels, adam, torch.arange(len(surfels)), children[1])


@torch.no_grad()
def prune(
    surfels: Surfels, adam: Adam, stats: Statistics | None, largest: float, off: Tensor | None = None
) -> tuple[Surfels, Tensor, dict[str, int]]:
    """Prune surfels that are transparent, larger than `largest`, not finite, (given statistics) occluded in all views, or `off` (n,) the
    surface by a pruning policy; return also the kept indices and the number of surfels by reason."""
    dropped = {
        "transparent": surfels.opacity() < MIN_RELATIVE_OPACITY * surfels.peak_opacity,
        "too large": surfels.scale.max(1).values > largest,
        "not finite": ~torch.isfinite(surfels.position).all(1),
    }
    if stats is not None:
        dropped["unseen"] = (stats.weight <= MIN_VIEW_WEIGHT * stats.views) & ~dropped["transparent"]
    if off is not None:
        dropped["off the surface"] = off
    bad = torch.stack(list(dropped.values())).any(0)
    keep = (~bad).nonzero()[:, 0]
    counts = {k: int(v.sum()) for k, v in dropped.items()}
    if len(keep) == len(surfels):
        return surfels, keep, counts
    return replace_rows(surfels, adam, keep, None), keep, counts


@torch.no_grad()
def reset_opacity(surfels: Surfels, opacity: float) -> int:
    """Lower the opacity of more opaque surfels to `opacity` (a share of the peak), in place, and return their number.

    |s| grows to the distance of that opacity, and the centre moves off the surface by as much, so that the surface μ − s n stays: photos
    decide anew which surfels show it. (The paper sets s to an opacity of .01 and leaves the centre, which moves the surface.)
    """
    if "opacity" in surfels.attributes:
        return 0
    distance = surfels.transfer.half_width(opacity) / surfels.gamma
    near = surfels.sdf.abs() < distance
    moved = torch.where(near, torch.where(surfels.sdf < 0, -distance, distance), surfels.sdf)
    surfels.position += (moved - surfels.sdf)[:, None] * surfels.normal()
    surfels.sdf.copy_(moved)
    return int(near.sum())
