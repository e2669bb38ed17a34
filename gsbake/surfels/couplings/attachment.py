"""Surfels on the zero level set: point-to-surface distance, normals along the gradient, opacity after the distance.

Lyu et al., *3DGSR* (2024): |f(μ)| and n ∥ ∇f. Li et al., *GS-Octree* (2024): the bell of f as a soft target of an opacity of its own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs

#: Distances beyond this many spacings are other surfaces: they pull no further.
MAX_SPACINGS = 6.0


def surface(inputs: CouplingInputs) -> Tensor:
    """Mean |f(μ)| of the surfels in view, in spacings."""
    spacing = inputs.spacing
    return (inputs.visible * (inputs.at_surfels[0].abs() / spacing).clamp_max(MAX_SPACINGS)).sum()


def alignment(inputs: CouplingInputs) -> Tensor:
    """Mean 1 − n·∇f/‖∇f‖ of the surfels in view."""
    g = F.normalize(inputs.at_surfels[1], dim=1, eps=1e-6)
    return (inputs.visible * (1 - (inputs.step.rendered.normal * g).sum(1))).sum()


def opacity_target(inputs: CouplingInputs) -> Tensor:
    """Mean |o − T(f(μ)) / peak| with the target detached, of the surfels in view; T is half of its peak one spacing away."""
    surfels = inputs.surfels
    with torch.no_grad():
        gamma = torch.as_tensor(surfels.transfer.half_width(0.5) / inputs.spacing).to(surfels.sdf)
        target = surfels.transfer.opacity(inputs.at_surfels[0], gamma) / surfels.transfer.peak
    return (inputs.visible * (surfels.opacity() - target).abs()).sum()
