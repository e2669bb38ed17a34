"""Depth and normals of the surfels and of the field supervise each other, each with the other detached (Zhu et al., *GS-ROR²*, 2024).

At first the surfels, which start from stereo and the hull, supervise the field alone: a field that is still rough would spoil them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs
from gsbake.surfels.losses.terms import PROJECTION_ERROR_MAX

#: Alpha of the field above which a ray has met it.
MIN_ALPHA = 0.5
#: Share of the run from which on the field supervises the surfels.
SURFELS_FROM = 0.5


def _both(inputs: CouplingInputs) -> Tensor:
    """Rays (m,) that meet both."""
    return (inputs.splat_depth.detach() > 0) & (inputs.march.alpha.detach() > MIN_ALPHA) & (inputs.covered > 0.5)


def _sum(inputs: CouplingInputs, on_field: Tensor, on_surfels: Tensor) -> Tensor:
    """The error of the field, and later that of the surfels too."""
    return on_field + on_surfels if inputs.step.share >= SURFELS_FROM else on_field


def depth(inputs: CouplingInputs) -> Tensor:
    """Mean of |D_f − D| with either detached; differences above `PROJECTION_ERROR_MAX` are other surfaces."""
    field, splats = inputs.march.depth, inputs.splat_depth
    ok = _both(inputs) & ((field - splats).detach().abs() < PROJECTION_ERROR_MAX)
    error = _sum(inputs, (field - splats.detach()).abs(), (splats - field.detach()).abs())
    return torch.where(ok, error, 0.0).sum() / ok.sum().clamp_min(1)


def normals(inputs: CouplingInputs) -> Tensor:
    """Mean of 1 − n_f·n with either detached."""
    field, splats = inputs.march.normal, inputs.splat_normal
    ok = _both(inputs)
    error = _sum(inputs, 1 - (field * splats.detach()).sum(1), 1 - (splats * field.detach()).sum(1))
    return torch.where(ok, error, 0.0).sum() / ok.sum().clamp_min(1)
