"""Surfels on the zero level set of a field: where it has none (Xiang et al., *GaussianRoom*, 2024), or all of them anew (the half of
SurfaceSplat's cycle that goes from the field to the splats: Gao et al., ICCV 2025).

A new surfel takes its orientation from ∇f, its size from the local spacing, and all else from the nearest surfel there is.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsbake.surfels.adam import Adam
from gsbake.surfels.densification.clone_split import replace_rows
from gsbake.surfels.field import Field
from gsbake.surfels.model import SCALE_TO_SPACING, Surfels, quaternion_from_normal
from gsbake.surfels.spacing import typical_spacing

#: The zero level set is empty where the nearest surfel is farther than this many spacings.
GAP_SPACINGS = 1.5
#: Points drawn on the zero level set per surfel that is wanted.
CANDIDATES = 3


def _tree(points: Tensor) -> cKDTree:
    return cKDTree(np.nan_to_num(points.detach().cpu().numpy().astype(np.float64), nan=1e6, posinf=1e6, neginf=-1e6))


def thin(points: Tensor, spacing: float) -> Tensor:
    """Indices of one of the points (n, 3) per cell of a voxel grid of this spacing, in their order."""
    cells = torch.floor(points / max(spacing, 1e-9)).long().cpu().numpy()
    return torch.from_numpy(np.sort(np.unique(cells, axis=0, return_index=True)[1]))


@torch.no_grad()
def _surfels_at(points: Tensor, normals: Tensor, like: Surfels, spacing: float) -> Surfels:
    nearest = torch.from_numpy(np.asarray(_tree(like.position).query(points.cpu().numpy().astype(np.float64))[1])).to(points.device)
    made = like.select(nearest)
    made.position, made.quaternion = points.clone(), quaternion_from_normal(normals)
    made.log_scale = torch.full_like(made.log_scale, float(np.log(SCALE_TO_SPACING * spacing)))
    made.sdf = torch.zeros_like(made.sdf)
    return made


@torch.no_grad()
def seed_gaps(surfels: Surfels, adam: Adam, field: Field, share: float, generator: torch.Generator) -> tuple[Surfels, int]:
    """Add surfels where the zero level set has none, at most `share` of their number; also how many."""
    room = int(share * len(surfels))
    if not room:
        return surfels, 0
    spacing = typical_spacing(surfels)
    points, normals = (x.to(surfels.position) for x in field.sample_near_zero(CANDIDATES * len(surfels), generator))
    if not len(points):
        return surfels, 0
    far = _tree(surfels.position).query(points.cpu().numpy().astype(np.float64))[0] > GAP_SPACINGS * spacing
    index = torch.from_numpy(np.flatnonzero(far))
    index = index[thin(points[index], spacing)][:room] if len(index) else index
    if not len(index):
        return surfels, 0
    index = index.to(points.device)
    made = _surfels_at(points[index], normals[index], surfels, spacing)
    return replace_rows(surfels, adam, torch.arange(len(surfels)), made), len(made)


@torch.no_grad()
def place_anew(surfels: Surfels, adam: Adam, field: Field, generator: torch.Generator) -> tuple[Surfels, int]:
    """Replace all surfels by as many, or fewer, evenly spread over the zero level set; also how many there are. They stay where the field
    has no surface."""
    count = len(surfels)
    points, normals = (x.to(surfels.position) for x in field.sample_near_zero(CANDIDATES * count, generator))
    if len(points) < max(10, count // 10):
        return surfels, 0
    # the voxel size that leaves about `count` points
    low, high = 1e-4, 1.0
    for _ in range(16):
        size = (low * high) ** 0.5
        if len(thin(points, size)) > count:
            low = size
        else:
            high = size
    index = thin(points, high).to(points.device)
    made = _surfels_at(points[index], normals[index], surfels, high)
    return replace_rows(surfels, adam, torch.zeros(0, dtype=torch.long), made), len(made)
