"""The sRGB transfer (IEC 61966-2-1) with gradients fit for training, and the neutral-light regulariser.

Photos are clipped at 1 by the sensor. `linear_to_srgb` clips likewise, but passes the gradient as if the curve went on straight beyond 1
(and below 0): where the photo is clipped too, the loss is flat and nothing happens; where the photo is darker, an overexposed pixel is
pulled back. A soft shoulder would punish every true highlight, a hard clamp would leave overexposed pixels stuck.
"""

from __future__ import annotations

from typing import Any

import torch

_KINK = 0.0031308
_SRGB_KINK = 0.04045
_SLOPE = 12.92


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, linear: torch.Tensor) -> torch.Tensor:
        clipped = linear.clamp(0.0, 1.0)
        power = clipped.clamp_min(_KINK).pow(1.0 / 2.4)
        out = torch.where(clipped > _KINK, 1.055 * power - 0.055, _SLOPE * clipped)
        ctx.save_for_backward(clipped, power)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
        clipped, power = ctx.saved_tensors
        slope = torch.where(clipped > _KINK, (1.055 / 2.4) * power / clipped.clamp_min(_KINK), _SLOPE)
        return grads[0] * slope


def linear_to_srgb(linear: torch.Tensor) -> torch.Tensor:
    """sRGB in [0, 1] of linear values, any shape; clipped values keep the slope of the nearer end as their gradient."""
    return _Encode.apply(linear)


def srgb_to_linear(srgb: torch.Tensor) -> torch.Tensor:
    """Linear values of sRGB ones, any shape; differentiable, not clipped (below 0 the linear piece goes on)."""
    return torch.where(srgb > _SRGB_KINK, ((srgb.clamp_min(_SRGB_KINK) + 0.055) / 1.055).pow(2.4), srgb / _SLOPE)


def colourfulness(radiance: torch.Tensor) -> torch.Tensor:
    """The white-light regulariser of METHOD: mean |L − channel mean of L| of radiance (…, 3), a scalar."""
    return (radiance - radiance.mean(dim=-1, keepdim=True)).abs().mean()
