"""Interface of densification and pruning policies: what they read, and their types.

A policy is a pure function of screen-space gradients and of the surfels' distances from the surface. Policies differ in how they use the
distance: not at all (3DGS), with widths fixed in the unit frame (GSDF, GaussianRoom, GS-ROR²), or with widths in surfel spacings, which
fit objects of any detail. Comparison: docs/decisions/0008-densify-policies.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from gsbake.surfels.model import Surfels
from gsbake.surfels.spacing import typical_spacing

#: Distance from the surface, in spacings, beyond which surfels are pruned in training; refinement has a setting for it.
MAX_DISTANCE_SPACINGS = 3.0


@dataclass(frozen=True)
class PolicyInputs:
    """What policies read of n surfels: `distance` (n,) ≥ 0 from the surface in the unit frame, 0 where it is unknown; `opacity` (n,) in
    0..1 as a share of the transfer function's peak; `spacing`, the typical distance between neighbours; `max_distance`, beyond which a
    surfel is off the surface."""

    distance: Tensor
    opacity: Tensor
    spacing: float
    max_distance: float

    @staticmethod
    def from_surfels(surfels: Surfels, distance: Tensor) -> PolicyInputs:
        """From the field's signed `distance` (n,) of the surfels, the spacing from their median scale."""
        spacing = typical_spacing(surfels)
        return PolicyInputs(distance.abs(), surfels.opacity() / surfels.peak_opacity, spacing, MAX_DISTANCE_SPACINGS * spacing)


#: Score (n,) from mean screen-space gradients (n,): the highest scores are densified, surfels with a score of 0 never.
DensificationPolicy = Callable[[Tensor, PolicyInputs], Tensor]
#: Which surfels (n,) are too far from the surface.
PruningPolicy = Callable[[PolicyInputs], Tensor]
