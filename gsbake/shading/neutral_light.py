"""Regularisation of the environment map towards grey."""

from __future__ import annotations

import torch


def colourfulness(radiance: torch.Tensor) -> torch.Tensor:
    """The white-light regularisation of Zhu et al. 2025: mean |L − channel mean of L| of radiance (…, 3), a scalar."""
    return (radiance - radiance.mean(dim=-1, keepdim=True)).abs().mean()
