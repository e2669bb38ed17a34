"""What makes a function a distance to a plausible surface: unit slope, little curvature, free space before surfaces, silhouettes.

Eikonal: Gropp et al., ICML 2020. Free space before the rendered depth: Xu et al., *Gsurf* (2024). Silhouettes: Yariv et al., *IDR*,
NeurIPS 2020, here on the least value along a ray.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs

#: Depths before the surfels' at which free space is sampled, and the margin before them in cells.
FREE_SAMPLES, FREE_MARGIN_CELLS = 4, 2.0
#: Depths along a ray of which the one with the least value is taken.
SILHOUETTE_SAMPLES = 24
#: Largest violation that counts (unit frame).
MAX_VIOLATION = 0.1


def eikonal(inputs: CouplingInputs) -> Tensor:
    """Mean (‖∇f‖ − 1)² at random points."""
    return ((inputs.points.g.norm(dim=1) - 1) ** 2).mean()


def smoothness(inputs: CouplingInputs) -> Tensor:
    """Mean ‖∇f(x) − ∇f(x + δ)‖ at random points near the surface, δ a random cell diagonal; the norm, not its square, allows edges."""
    points, field = inputs.points, inputs.field
    if not points.near:
        return points.f.sum() * 0
    step = torch.randn(points.near, 3, generator=inputs.step.generator).to(points.x)
    step = step / step.norm(dim=1, keepdim=True).clamp_min(1e-6) * (1.5 * field.cell)
    moved = field.evaluate(points.x[: points.near] + step)[1]
    return ((points.g[: points.near] - moved) ** 2).sum(1).add(1e-6).sqrt().mean()


def free_space(inputs: CouplingInputs) -> Tensor:
    """Mean relu(−f) in cells at random depths before the surfels' depth."""
    rays, depth, field = inputs.rays, inputs.splat_depth.detach(), inputs.field
    end = depth - FREE_MARGIN_CELLS * field.cell / rays.length
    share = torch.rand(len(depth), FREE_SAMPLES, generator=inputs.step.generator).to(depth)
    z = rays.near[:, None] + share * (end - rays.near)[:, None]
    ok = (depth > 0) & (end > rays.near)
    f = field.evaluate(rays.at(z).reshape(-1, 3))[0].view(z.shape)
    violation = (-f).clamp(0, MAX_VIOLATION) / field.cell
    return torch.where(ok[:, None], violation, 0.0).sum() / (ok.sum() * FREE_SAMPLES).clamp_min(1)


def silhouette(inputs: CouplingInputs) -> Tensor:
    """Rays outside the mask stay outside, rays inside meet the surface: the least value along them is pushed over or under 0 (in cells)."""
    rays, field = inputs.rays, inputs.field
    crosses = rays.near < rays.far
    with torch.no_grad():
        jitter = torch.rand(len(rays.near), SILHOUETTE_SAMPLES, generator=inputs.step.generator).to(rays.near)
        share = (torch.arange(SILHOUETTE_SAMPLES, device=jitter.device) + jitter) / SILHOUETTE_SAMPLES
        z = rays.near[:, None] + share * (rays.far - rays.near).clamp_min(0)[:, None]
        values = field.value(rays.at(z).reshape(-1, 3)).view(z.shape)
        least = values.argmin(1, keepdim=True)
        z = z.gather(1, least)
    f = field.evaluate(rays.at(z)[:, 0])[0] / field.cell
    inside = inputs.covered > 0.5
    violation = torch.where(inside, f, -f).clamp(0, MAX_VIOLATION / field.cell)
    ok = crosses & ((inputs.covered > 0.9) | (inputs.covered < 0.1))
    return torch.where(ok, violation, 0.0).sum() / ok.sum().clamp_min(1)
