"""The sRGB tone curve (IEC 61966-2-1) with gradients fit for training.

Photos are clipped at 1 by the sensor. `linear_to_srgb` clips likewise, but passes the gradient as if the curve continued straight beyond 1
(and below 0). Where the photo is clipped too, the loss is flat; where the photo is darker, an overexposed pixel is pulled back. A soft
shoulder would penalise every true highlight, a hard clamp would leave overexposed pixels without gradient.
"""

from __future__ import annotations

from typing import Any

import torch

from gsbake.imaging.srgb import CODED_KINK, GAMMA, KINK, OFFSET, SCALE, SLOPE


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, linear: torch.Tensor) -> torch.Tensor:
        clipped = linear.clamp(0.0, 1.0)
        power = clipped.clamp_min(KINK).pow(1.0 / GAMMA)
        out = torch.where(clipped > KINK, SCALE * power - OFFSET, SLOPE * clipped)
        ctx.save_for_backward(clipped, power)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
        clipped, power = ctx.saved_tensors
        slope = torch.where(clipped > KINK, (SCALE / GAMMA) * power / clipped.clamp_min(KINK), SLOPE)
        return grads[0] * slope


def linear_to_srgb(linear: torch.Tensor) -> torch.Tensor:
    """sRGB in [0, 1] of linear values, any shape; clipped values keep the slope of the nearer end as their gradient."""
    return _Encode.apply(linear)


def srgb_to_linear(srgb: torch.Tensor) -> torch.Tensor:
    """Linear values of sRGB ones, any shape; differentiable, not clipped (below 0 the linear piece continues)."""
    return torch.where(srgb > CODED_KINK, ((srgb.clamp_min(CODED_KINK) + OFFSET) / SCALE).pow(GAMMA), srgb / SLOPE)
