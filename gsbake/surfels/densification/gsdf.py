"""Densification and pruning of GSDF (Yu et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs

#: Scale of the squared distance (unit frame), and the minimum opacity that must remain.
SQUARED_SCALE, MIN_OPACITY = 0.01, 0.005


def _proximity(surfels: PolicyInputs) -> Tensor:
    """exp(−s²/.01) (n,): 1 on the surface."""
    return torch.exp(-(surfels.distance**2) / SQUARED_SCALE)


def score(gradient: Tensor, surfels: PolicyInputs) -> Tensor:
    """gradient + ω exp(−s²/.01). ω is the mean gradient, so that it needs no constant in the loss's units."""
    return gradient + gradient.mean() * _proximity(surfels)


def prune(surfels: PolicyInputs) -> Tensor:
    """Opacity − (1 − exp(−s²/.01)) < .005. GSDF takes the mean opacity over N steps; this is the current one."""
    return surfels.opacity - (1 - _proximity(surfels)) < MIN_OPACITY
