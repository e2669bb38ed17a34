"""Quantities of the split sum that only tests ask for."""

from __future__ import annotations

import torch

from gsbake.shading import brdf
from gsbake.shading.split_sum import soft_cosine, unit


def transmitted_share(normal: torch.Tensor, view: torch.Tensor, roughness: torch.Tensor) -> torch.Tensor:
    """Share (n,) of diffuse reflection that a dielectric's specular layer lets through, 1 − D."""
    return 1.0 - brdf.split_sum(soft_cosine((unit(normal) * view).sum(dim=1)), roughness).dielectric
