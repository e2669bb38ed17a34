"""Rendered extra views teach the field where few photos look (Gao et al., *SurfaceSplat*, ICCV 2025).

The surfels are rendered between two photos' cameras, and the field takes their depth and normals there. The other half of the cycle,
surfels placed on the field's zero level set, is `gsbake.surfels.densification.seeding`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.couplings.inputs import CouplingInputs
from gsbake.surfels.couplings.ray_marching import make_rays, march, sample_depths
from gsbake.surfels.gbuffer import rasterise
from gsbake.surfels.losses.terms import PROJECTION_ERROR_MAX
from gsbake.surfels.views import TrainView


def view_between(first: TrainView, second: TrainView, share: float) -> TrainView:
    """The camera at `share` of the way from one view to another, at their blended distance and orientation, with the first's photo."""

    def axis(a: Tensor, b: Tensor) -> Tensor:
        blended = F.normalize((1 - share) * a + share * b, dim=0, eps=1e-6)
        return blended if bool(torch.isfinite(blended).all()) and float(blended.norm()) > 0.5 else a

    forward = axis(first.R[2], second.R[2])
    down = axis(first.R[1], second.R[1])
    right = F.normalize(torch.linalg.cross(down, forward), dim=0, eps=1e-6)
    if float(right.norm()) < 0.5:
        return first
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    direction = axis(first.centre / first.centre.norm().clamp_min(1e-6), second.centre / second.centre.norm().clamp_min(1e-6))
    centre = direction * ((1 - share) * first.centre.norm() + share * second.centre.norm())
    return TrainView(f"{first.name}+{second.name}", first.rgb, first.mask, rotation, -rotation @ centre, centre, first.pinhole)


def extra_views(inputs: CouplingInputs) -> Tensor:
    """Mean |D_f − D| in cells plus mean 1 − n_f·n on rays of a rendered view between this photo's camera and another's."""
    step, field, settings = inputs.step, inputs.field, inputs.settings
    others = step.views
    if len(others) < 2:
        return inputs.points.f.sum() * 0
    # one of the nearest cameras: far ones look from behind
    cosine = torch.stack([(v.R[2] * inputs.view.R[2]).sum() for v in others])
    ranked = torch.argsort(cosine, descending=True)[1:4]
    other = others[int(ranked[int(torch.randint(len(ranked), (1,), generator=step.generator))])]
    between = view_between(inputs.view, other, float(0.25 + 0.5 * torch.rand(1, generator=step.generator)))
    with torch.no_grad():
        out = rasterise(step.surfels, between)
        seen = (out.alpha > 0.9).flatten().nonzero()[:, 0]
        if not len(seen):
            return inputs.points.f.sum() * 0
        pixel = seen[torch.randint(len(seen), (settings.rays // 2,), generator=step.generator).to(seen.device)]
        depth = out.expected_depth().flatten()[pixel]
        normal = F.normalize(out.features[-3:].flatten(1)[:, pixel].T, dim=1, eps=1e-6)
        rays = make_rays(between, pixel, field.lower.to(depth), field.upper.to(depth))
        half = (3 * field.value(rays.at(depth[:, None])[:, 0]).abs()).clamp_min(3 * field.cell) / rays.length
        z = sample_depths(rays, settings.ray_samples, depth, half, torch.ones_like(depth, dtype=torch.bool), step.generator)
    m = march(rays, z, settings.renderer, field.sharpness(step.share), field.evaluate)
    met = (m.alpha.detach() > 0.5) & ((m.depth - depth).detach().abs() < PROJECTION_ERROR_MAX)
    error = (m.depth - depth).abs() / field.cell + 1 - (m.normal * normal).sum(1)
    return torch.where(met, error, 0.0).sum() / met.sum().clamp_min(1)
