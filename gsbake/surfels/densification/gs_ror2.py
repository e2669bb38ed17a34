"""Pruning of GS-ROR² (Zhu et al. 2024)."""

from __future__ import annotations

from torch import Tensor

from gsbake.surfels.densification.policy import PolicyInputs

#: Largest distance from the zero level set (unit frame).
MAX_DISTANCE = 0.03


def prune(surfels: PolicyInputs) -> Tensor:
    """|s| > .03."""
    return surfels.distance > MAX_DISTANCE
