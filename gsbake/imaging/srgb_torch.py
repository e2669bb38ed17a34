"""Differentiable sRGB tone curve (IEC 61966-2-1) for training.

The sensor clips photos at 1. `linear_to_srgb` clips likewise, but its gradient continues linearly above 1 (and below 0): where the photo is
clipped too, the loss is constant; where it is darker, overexposed pixels have a gradient. A soft shoulder would penalise true highlights; a
hard clamp would leave overexposed pixels without gradient.
"""

from __future__ import annotations

from typing import Any

import torch

from gsbake.imaging.srgb import GAMMA, LINEAR_THRESHOLD, OFFSET, SCALE, SLOPE


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, linear: torch.Tensor) -> torch.Tensor:
        clipped = linear.clamp(0.0, 1.0)
        power = clipped.clamp_min(LINEAR_THRESHOLD).pow(1.0 / GAMMA)
        out = torch.where(clipped > LINEAR_THRESHOLD, SCALE * power - OFFSET, SLOPE * clipped)
        ctx.save_for_backward(clipped, power)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
        clipped, power = ctx.saved_tensors
        slope = torch.where(clipped > LINEAR_THRESHOLD, (SCALE / GAMMA) * power / clipped.clamp_min(LINEAR_THRESHOLD), SLOPE)
        return grads[0] * slope


def linear_to_srgb(linear: torch.Tensor) -> torch.Tensor:
    """sRGB in [0, 1] of linear values, any shape; the gradient of clipped values is that of the nearer end."""
    return _Encode.apply(linear)
