"""No densification."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs


def score(gradient: Tensor, surfels: PolicyInputs) -> Tensor:
    """0 for every surfel (n,)."""
    return torch.zeros_like(gradient)
