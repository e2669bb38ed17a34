"""SDF → opacity: the sech² bump of the discretized SDF (Zhu et al., ICCV 2025, eq. 5), its inverse and derivative.

o = T_γ(s) = sech²(γ s / 2), evaluated as 4 t / (1 + t)² with t = exp(−γ|s|): the literal 4 e^{−γs} / (1 + e^{−γs})² is
inf/inf below γ s ≈ −88 in float32.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: γ|s| at which T = ½: 2 arccosh(√2).
HALF = 2.0 * math.acosh(math.sqrt(2.0))

#: γ with T(0.1) = 0.95, the sharpness aimed at once the SDF median is small.
GAMMA_GOAL = 2.0 * math.acosh(1.0 / math.sqrt(0.95)) / 0.1


def opacity(sdf: Tensor, gamma: Tensor) -> Tensor:
    """Opacity in [0, 1] of SDF samples (n,) at sharpness `gamma` (scalar or (n,)); even in sdf, 1 at 0."""
    t = torch.exp(-(gamma * sdf).abs())
    return 4 * t / (1 + t) ** 2


def distance(alpha: Tensor, gamma: Tensor) -> Tensor:
    """|s| with T_γ(s) = alpha, for alpha in (0, 1]."""
    return 2 / gamma * torch.acosh(alpha.clamp(1e-12, 1).rsqrt())


def median_target(median: float) -> float:
    """Sharpness aimed at for a median |s|: T(median) = ½ while the samples are wide, then the constant `GAMMA_GOAL`."""
    return HALF / median if median > 0.1 else GAMMA_GOAL
