"""Pulling: points near the surfels, moved to the zero level set by f and ∇f, land on the nearest surfel (Zhang et al., *GS-Pull*, 2024)."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs

#: Weight of the distance within the surfel's plane, beside that along its normal: a disc is wide.
TANGENTIAL = 0.1


def pulling(inputs: CouplingInputs) -> Tensor:
    """Mean distance in spacings from q − f ∇f/‖∇f‖ to the disc of the surfel nearest to it, at random points q near the surfels."""
    points, surfels = inputs.points, inputs.surfels
    if not points.near:
        return points.f.sum() * 0
    x, f, g = points.x[: points.near], points.f[: points.near], points.g[: points.near]
    pulled = x - f[:, None] * g / g.norm(dim=1, keepdim=True).clamp_min(1e-3)
    centres = surfels.position.detach()
    tree = cKDTree(np.nan_to_num(centres.cpu().numpy().astype(np.float64)))
    query = torch.nan_to_num(pulled.detach(), 0.0, 1e3, -1e3).cpu().numpy().astype(np.float64)
    nearest = torch.from_numpy(np.asarray(tree.query(query, workers=-1)[1])).to(centres.device)
    offset = pulled - centres[nearest]
    normal = inputs.step.rendered.normal.detach()[nearest]
    along = (offset * normal).sum(1)
    across = (offset - along[:, None] * normal).norm(dim=1)
    return ((along.abs() + TANGENTIAL * across) / inputs.spacing).clamp_max(6.0).mean()
