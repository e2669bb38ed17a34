"""Densification by the mean screen-space gradient (3DGS, Kerbl et al. 2023; the discretized SDF uses it too)."""

from __future__ import annotations

from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs


def score(gradient: Tensor, surfels: PolicyInputs) -> Tensor:
    """The gradient (n,) itself."""
    return gradient
