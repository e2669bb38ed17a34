"""Given maps of normals and depth per photo (monocular estimates, or any other source) as priors of surfels and field.

GaussianRoom (Xiang et al. 2024) and UGSDF (Tourani et al. 2025) take such maps from networks; here they come with the capture. Depths count
up to a scale and a shift per photo, as in MonoSDF (Yu et al., NeurIPS 2022).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs


def normals(inputs: CouplingInputs) -> Tensor:
    """Mean of ‖n − n̂‖₁ + 1 − n·n̂ for the surfels and the field on rays with a given normal n̂; 0 without maps."""
    given = inputs.view.normals
    if given is None:
        return inputs.splat_normal.sum() * 0
    rays = inputs.rays
    n = given.flatten(1)[:, rays.pixel].T.float() / 127
    ok = (n.norm(dim=1) > 0.5) & (inputs.covered > 0.5)
    n = F.normalize(n, dim=1, eps=1e-6) @ inputs.view.R  # camera → unit frame
    total = inputs.splat_normal.new_zeros(())
    for predicted in (inputs.splat_normal, inputs.march.normal):
        error = (predicted - n).abs().sum(1) + 1 - (predicted * n).sum(1)
        total = total + torch.where(ok, error, 0.0).sum() / ok.sum().clamp_min(1)
    return total


def fit_scale_and_shift(given: Tensor, target: Tensor) -> Tensor:
    """a · given + b (m,) with a, b of least squares to `target` (m,); the mean of the target where the given values do not vary."""
    centred = given - given.mean()
    variance = (centred**2).mean()
    a = torch.where(variance > 1e-12, (centred * (target - target.mean())).mean() / variance.clamp_min(1e-12), torch.zeros_like(variance))
    return a * centred + target.mean()


def depths(inputs: CouplingInputs) -> Tensor:
    """Mean |D − (a D̂ + b)| in cells for surfels and field on rays with a given depth D̂, a and b fitted to the current depths."""
    given = inputs.view.depths
    if given is None:
        return inputs.splat_depth.sum() * 0
    d = given.flatten()[inputs.rays.pixel]
    total = inputs.splat_depth.new_zeros(())
    for predicted, met in ((inputs.splat_depth, inputs.splat_depth > 0), (inputs.march.depth, inputs.march.alpha > 0.5)):
        ok = met.detach() & (d > 0) & (inputs.covered > 0.5)
        if int(ok.sum()) >= 16:
            target = fit_scale_and_shift(d[ok], predicted[ok].detach())
            total = total + ((predicted[ok] - target).abs() / inputs.field.cell).clamp_max(10).mean()
    return total
