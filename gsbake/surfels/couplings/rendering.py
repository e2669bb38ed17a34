"""The field rendered by ray marching against the photo: colours of its own, and coverage against the mask.

NeuS (Wang et al. 2021), VolSDF (Yariv et al. 2021), SDF-3DGAN (Jiang et al. 2023), by `field.renderer`; the samples as in GSDF (Yu et al.
2024) around the surfels' depth, or by sphere tracing.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs


def colour(inputs: CouplingInputs) -> Tensor:
    """Mean absolute difference of marched colours and the photo inside the mask."""
    m, rays, field = inputs.march, inputs.rays, inputs.field
    assert field.radiance is not None
    view = F.normalize(rays.direction, dim=1)[:, None].expand(m.x.shape)
    normal = F.normalize(m.g, dim=2, eps=1e-6)
    rgb = field.radiance(m.x.detach().reshape(-1, 3), normal.reshape(-1, 3), view.reshape(-1, 3)).view(m.x.shape)
    marched = (m.w[..., None] * rgb).sum(1)
    photo = inputs.view.colour().flatten(1)[:, rays.pixel].T
    inside = inputs.covered
    target = photo * inside[:, None]
    return (marched - target).abs().mean()


def mask(inputs: CouplingInputs) -> Tensor:
    """Cross-entropy of the marched alpha and the mask."""
    alpha, cover = inputs.march.alpha.clamp(1e-4, 1 - 1e-4), inputs.covered
    return -(cover * alpha.log() + (1 - cover) * (1 - alpha).log()).mean()
