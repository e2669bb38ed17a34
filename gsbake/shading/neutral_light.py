"""Neutral-light regularisation of the environment map."""

from __future__ import annotations

import torch


def neutral_light_loss(radiance: torch.Tensor) -> torch.Tensor:
    """Neutral-light regularisation of Zhu et al. 2025: mean |L − channel mean of L| of radiance (…, 3), a scalar."""
    return (radiance - radiance.mean(dim=-1, keepdim=True)).abs().mean()
