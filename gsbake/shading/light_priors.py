"""Priors of the environment map: most light is neutral, and neighbouring directions are similar.

Both only matter where photos leave the light open. Rough dielectrics leave most of its detail open: without smoothness the fit puts a few
bright spots on black.
"""

from __future__ import annotations

import torch

#: Least radiance whose square root is differentiated.
_MIN_RADIANCE = 1e-12


def neutral_light_loss(radiance: torch.Tensor) -> torch.Tensor:
    """Neutral-light regularisation of Zhu et al. 2025: mean |L − channel mean of L| of radiance (…, 3), a scalar."""
    return (radiance - radiance.mean(dim=-1, keepdim=True)).abs().mean()


def light_smoothness_loss(radiance: torch.Tensor) -> torch.Tensor:
    """Total variation of √L, a scalar: mean |Δ| along rows plus that along columns of the faces of a cube map (6, size, size, 3).

    Smoothness of the light as in Zhang et al., *NeRFactor*, 2021; with the norm of total variation, and of the square root, lamps may be.
    """
    root = radiance.clamp_min(_MIN_RADIANCE).sqrt()
    return (root[:, 1:] - root[:, :-1]).abs().mean() + (root[:, :, 1:] - root[:, :, :-1]).abs().mean()
