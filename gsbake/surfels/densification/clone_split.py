"""Adding and dropping surfels: clone and split under a budget, and pruning by opacity, size, visibility and distance from the surface.

Clone/split after 3DGS (Kerbl et al. 2023); children inherit s (Zhu et al. 2025). Instead of a fixed threshold the surfels with the
largest score (`policies.py`: the mean screen gradient, or that and the SDF sample) are taken, as many as a budget that grows to
`surfels.max_count` allows: no scene-dependent constant to guess.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbake.surfels.densification.policies import Placement
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.reference import rotation_matrix
from gsbake.surfels.training.adam import Adam

#: Share of the transfer's peak opacity below which a surfel is dropped (DSDF: .005, its peak is 1).
OPACITY_FLOOR = 0.005
#: Mean weight per view (in pixels) below which a surfel counts as hidden: it lies behind others and costs time without being seen.
HIDDEN_WEIGHT = 0.05
#: Discs start with a σ of this share of the distance to their neighbours (`surfels.create`), and keep near it while they cover the surface.
DISC_SHARE = 0.6
#: Spacings from the surface beyond which a surfel counts as off it in training; refine has a setting for it.
FAR_SPACINGS = 3.0


@dataclass
class Statistics:
    """Per surfel since the last change: summed screen gradient (pixels at unit resolution), views that touched it, summed weight."""

    gradient: Tensor
    views: Tensor
    weight: Tensor

    @staticmethod
    def zeros(n: int, device: str | torch.device = "cpu") -> Statistics:
        """Fresh statistics for n surfels."""
        return Statistics(*(torch.zeros(n, device=device) for _ in range(3)))

    def add(self, screen_grad: Tensor, touched: Tensor, size: int) -> None:
        """Collect one backward pass: gradients (n, ≥2) w.r.t. the screen centre in pixels, weights (n,); `size` makes them
        resolution-free."""
        seen = touched > 0
        self.gradient += torch.where(seen, torch.hypot(screen_grad[:, 0], screen_grad[:, 1]) * (size / 2), 0.0)
        self.views += seen
        self.weight += touched

    def mean_gradient(self) -> Tensor:
        """Mean screen gradient (n,) over the views that touched each surfel."""
        return self.gradient / self.views.clamp_min(1)


def placement(surfels: Surfels) -> Placement:
    """Where the surfels stand by their own SDF samples, the spacing read off the median disc."""
    spacing = float(surfels.scale.max(1).values.median()) / DISC_SHARE if len(surfels) else 1.0
    return Placement(surfels.sdf.abs(), surfels.opacity() / surfels.transfer.peak, spacing, FAR_SPACINGS * spacing)


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
    """Split (scale above `large`) or clone the surfels with the largest `score` (n,) until `budget` surfels exist; a score of 0 never does.

    A split surfel becomes two of 1/1.6 its size at random places of its disc; a clone is a copy.
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
        place = parents.position + torch.einsum("nij,nj->ni", axes, offset)
        child = parents.select(torch.arange(len(chosen)))
        child.position = torch.where(split[:, None], place, parents.position)
        child.log_scale = torch.where(split[:, None], parents.log_scale - math.log(1.6), parents.log_scale)
        children.append(child)
    # the first child takes its parent's row, moments and all
    surfels.position[chosen] = children[0].position
    surfels.log_scale[chosen] = children[0].log_scale
    return replace_rows(surfels, adam, torch.arange(len(surfels)), children[1])


@torch.no_grad()
def prune(
    surfels: Surfels, adam: Adam, stats: Statistics | None, largest: float, off: Tensor | None = None
) -> tuple[Surfels, Tensor, dict[str, int]]:
    """Drop surfels that are transparent, larger than `largest`, not finite, (given statistics) hidden in all views, or `off` (n,) the
    surface by a rule of `policies.py`; returns also the kept index and how many fell to each reason."""
    dropped = {
        "transparent": surfels.opacity() < OPACITY_FLOOR * surfels.transfer.peak,
        "too large": surfels.scale.max(1).values > largest,
        "not finite": ~torch.isfinite(surfels.position).all(1),
    }
    if stats is not None:
        dropped["unseen"] = (stats.weight <= HIDDEN_WEIGHT * stats.views) & ~dropped["transparent"]
    if off is not None:
        dropped["off the surface"] = off
    bad = torch.stack(list(dropped.values())).any(0)
    keep = (~bad).nonzero()[:, 0]
    counts = {k: int(v.sum()) for k, v in dropped.items()}
    if len(keep) == len(surfels):
        return surfels, keep, counts
    return replace_rows(surfels, adam, keep, None), keep, counts
