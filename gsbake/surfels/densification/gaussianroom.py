"""Densification and pruning of GaussianRoom (Xiang et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs

#: η above which surfels may be densified, and η below which they are pruned (the paper says only "small").
MIN_DENSIFY_ETA, MIN_ETA = 0.95, 0.005


def _eta(surfels: PolicyInputs) -> Tensor:
    """η = exp(−s²/(2o²)) (n,): an opaque surfel may be farther from the surface than a nearly transparent one."""
    return torch.exp(-(surfels.distance**2) / (2 * surfels.opacity.clamp_min(1e-6) ** 2))


def score(gradient: Tensor, surfels: PolicyInputs) -> Tensor:
    """The gradient where η > .95, else 0."""
    return torch.where(_eta(surfels) > MIN_DENSIFY_ETA, gradient, 0.0)


def prune(surfels: PolicyInputs) -> Tensor:
    """η below .005."""
    return _eta(surfels) < MIN_ETA
