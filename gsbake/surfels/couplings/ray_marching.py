"""Rays through a field: where to sample, and weights of the samples by the transfer functions of the literature.

A ray is x(z) = c + z d with d = Rᵀ K⁻¹ (x, y, 1), so z is the depth along the camera's axis, as the rasteriser's. Samples lie around the
depth of the surfels, D ± 3 |f(x(D))| (Yu et al., GSDF, NeurIPS 2024), or around the hit of sphere tracing (Hart 1996; Jiang et al.,
SDF-3DGAN, 2023), or all over the box. Weights are w_i = α_i Π_{j<i} (1 − α_j) with

| name | α of an interval of length δ between f₀ and f₁ | after |
|---|---|---|
| neus | max(0, (Φ(f₀) − Φ(f₁)) / Φ(f₀)), Φ the logistic CDF of sharpness γ | Wang et al., NeuS, NeurIPS 2021 |
| laplace | 1 − exp(−γ δ Ψ(−f)), Ψ the Laplace CDF of scale 1/γ | Yariv et al., VolSDF, NeurIPS 2021 |
| logistic | 1 − exp(−γ δ sech²(γ f / 2)), the logistic bump | Jiang et al., SDF-3DGAN, 2023 |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbake.surfels.views import TrainView

#: Steps of sphere tracing.
TRACE_STEPS = 10
#: Depth of the nearest sample (unit frame).
NEAR = 0.05
#: Largest half-width of the interval around a depth.
MAX_HALF_WIDTH = 0.3


@dataclass(frozen=True)
class Rays:
    """m rays of one view: flat `pixel` indices (m,), `origin` (3,), `direction` (m, 3) with unit depth, its `length` (m,), and the depths
    `near`, `far` (m,) between which they cross the field's box (near > far where they miss it)."""

    pixel: Tensor
    origin: Tensor
    direction: Tensor
    length: Tensor
    near: Tensor
    far: Tensor

    def at(self, z: Tensor) -> Tensor:
        """Points (m, k, 3) at depths (m, k)."""
        return self.origin + z[..., None] * self.direction[:, None]


@dataclass(frozen=True)
class March:
    """Samples of m rays: points (m, k, 3), depths `z` (m, k), values `f` (m, k), gradients `g` (m, k, 3), weights `w` (m, k)."""

    x: Tensor
    z: Tensor
    f: Tensor
    g: Tensor
    w: Tensor

    @property
    def alpha(self) -> Tensor:
        """Σ w (m,)."""
        return self.w.sum(1)

    @property
    def depth(self) -> Tensor:
        """Expected depth (m,), divided by alpha."""
        return (self.w * self.z).sum(1) / self.alpha.clamp_min(1e-4)

    @property
    def normal(self) -> Tensor:
        """Unit normal (m, 3)."""
        return torch.nn.functional.normalize((self.w[..., None] * self.g).sum(1), dim=1, eps=1e-6)


def make_rays(view: TrainView, pixel: Tensor, lower: Tensor, upper: Tensor) -> Rays:
    """The rays of flat pixel indices (m,) and where they cross the box."""
    p = view.pinhole
    x = ((pixel % p.width).to(view.R) + 0.5 - p.cx) / p.fx
    y = ((pixel // p.width).to(view.R) + 0.5 - p.cy) / p.fy
    direction = torch.stack([x, y, torch.ones_like(x)], 1) @ view.R
    inverse = 1 / torch.where(direction.abs() > 1e-9, direction, 1e-9)
    a, b = (lower - view.centre) * inverse, (upper - view.centre) * inverse
    near = torch.minimum(a, b).amax(1).clamp_min(NEAR)
    return Rays(pixel, view.centre, direction, direction.norm(dim=1), near, torch.maximum(a, b).amin(1))


def alphas(name: str, f: Tensor, length: Tensor, sharpness: Tensor) -> Tensor:
    """α (m, k) of samples with values `f` (m, k) and interval lengths (m, k); those of neus take the slope between neighbours."""
    if name == "neus":
        # values at the ends of each sample's interval by the differences to its neighbours
        slope = torch.zeros_like(f)
        slope[:, :-1] = (f[:, 1:] - f[:, :-1]) / 2
        slope[:, -1:] = slope[:, -2:-1]
        entry, leave = torch.sigmoid(sharpness * (f - slope)), torch.sigmoid(sharpness * (f + slope))
        return ((entry - leave) / entry.clamp_min(1e-6)).clamp(0, 1)
    x = sharpness * f
    if name == "laplace":
        half = 0.5 * torch.exp(-x.abs())
        density = torch.where(x < 0, 1 - half, half)
    else:
        t = torch.exp(-x.abs())
        density = 4 * t / (1 + t) ** 2
    return -torch.expm1(-sharpness * density * length)


def weights(alpha: Tensor) -> Tensor:
    """w_i = α_i Π_{j<i} (1 − α_j) (m, k)."""
    through = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1] * (1 - 1e-6)], 1), 1)
    return alpha * through


@torch.no_grad()
def sphere_trace(value: Callable[[Tensor], Tensor], rays: Rays) -> tuple[Tensor, Tensor]:
    """Depth (m,) at which each ray meets the zero level set, and whether it does; `value` is the signed distance (n,) at points (n, 3)."""
    z = rays.near.clone()
    f = torch.ones_like(z)
    for _ in range(TRACE_STEPS):
        f = value(rays.at(z[:, None])[:, 0])
        z = (z + f / rays.length).clamp_min(NEAR)
    return z, (f.abs() < 0.02) & (z < rays.far) & (rays.near < rays.far)


def sample_depths(
    rays: Rays, count: int, centre: Tensor, half_width: Tensor, known: Tensor, generator: torch.Generator
) -> Tensor:
    """Depths (m, count), stratified and jittered: within `half_width` (m,) of `centre` (m,) where `known` (m,), else over the box."""
    half_width = half_width.clamp_max(MAX_HALF_WIDTH)
    lower = torch.where(known, centre - half_width, rays.near).clamp_min(NEAR)
    upper = torch.where(known, centre + half_width, torch.maximum(rays.far, rays.near + 1e-3))
    jitter = torch.rand(len(centre), count, generator=generator).to(centre)
    share = (torch.arange(count, device=centre.device) + jitter) / count
    return lower[:, None] + share * (upper - lower).clamp_min(1e-4)[:, None]


def march(rays: Rays, z: Tensor, transfer: str, sharpness: Tensor, evaluate: Callable[[Tensor], tuple[Tensor, Tensor]]) -> March:
    """Weights of the samples at depths `z` (m, k); `evaluate` returns the field's value and gradient at points (n, 3)."""
    x = rays.at(z)
    f, g = evaluate(x.reshape(-1, 3))
    f, g = f.view(z.shape), g.view(*z.shape, 3)
    step = torch.diff(z, dim=1)
    length = torch.cat([step, step[:, -1:]], 1) * rays.length[:, None]
    return March(x, z, f, g, weights(alphas(transfer, f, length, sharpness)))
