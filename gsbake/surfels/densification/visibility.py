"""Pruning by visibility alone (3DGS, Kerbl et al. 2023)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs


def prune(surfels: PolicyInputs) -> Tensor:
    """No surfel (n,) is pruned for its distance: opacity, size and visibility decide (`clone_split.prune`)."""
    return torch.zeros_like(surfels.distance, dtype=torch.bool)
