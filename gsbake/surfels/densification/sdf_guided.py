"""Densification and pruning by the distance from the surface in surfel spacings: no constant that depends on the scene."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs


def score(gradient: Tensor, surfels: PolicyInputs) -> Tensor:
    """gradient · exp(−s²/2d²), d the spacing: off the surface by more than a spacing, the gradient shows a misplaced surfel, not
    undersampling."""
    return gradient * torch.exp(-(surfels.distance**2) / (2 * surfels.spacing**2))


def prune(surfels: PolicyInputs) -> Tensor:
    """Farther than `max_distance`: the rule of GS-ROR² in spacings."""
    return surfels.distance > surfels.max_distance
