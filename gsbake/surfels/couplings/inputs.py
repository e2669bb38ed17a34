"""What couplings read in one step, computed once and only when asked for: the field at the surfels, at random points and along rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.densification.policy import typical_spacing
from gsbake.surfels.fields.field import TrainingStep
from gsbake.surfels.fields.ray_marching import March, Rays, make_rays, march, sample_depths, sphere_trace
from gsbake.surfels.training.views import TrainView

if TYPE_CHECKING:
    from gsbake.surfels.fields.continuous import ContinuousField

#: Share of the rays inside the mask; the others are drawn around it.
INSIDE_SHARE = 0.8
#: Pixels around the mask in which rays outside are drawn.
BORDER = 12
#: Half-width of the interval on a ray in units of the distance at the surfels' depth, and its least in cells.
BAND, MIN_BAND_CELLS = 3.0, 3.0
#: Random points: share near the surface, and their standard deviation from it in cells.
NEAR_SHARE, NEAR_CELLS = 0.75, 2.0


@dataclass(frozen=True)
class Points:
    """Random points (n, 3), the field's value (n,) and gradient (n, 3) there; the first `near` lie near the surfels."""

    x: Tensor
    f: Tensor
    g: Tensor
    near: int


class CouplingInputs:
    """Lazily evaluated inputs of one step."""

    def __init__(self, field: ContinuousField, step: TrainingStep, view: TrainView) -> None:
        """`view` is the photo of the step, whose render is in `step`."""
        self.field, self.step, self.view = field, step, view
        self.settings: Any = field.settings
        self.surfels = step.surfels

    @cached_property
    def at_surfels(self) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3) at the centres."""
        return self.field.at_surfels(self.surfels)

    @cached_property
    def spacing(self) -> float:
        """Typical distance (unit frame) between neighbouring surfels."""
        return max(typical_spacing(self.surfels), 1e-6)

    @cached_property
    def visible(self) -> Tensor:
        """Surfels (n,) in this view's frame as weights that sum to 1."""
        shown = self.step.rendered.visible.to(self.surfels.position)
        return shown / shown.sum().clamp_min(1)

    @cached_property
    def points(self) -> Points:
        """Random points near the surfels and all over the box."""
        generator, settings = self.step.generator, self.settings
        count = settings.points
        near = round(NEAR_SHARE * count) if len(self.surfels) else 0
        lower, upper = self.field.lower.to(self.surfels.position), self.field.upper.to(self.surfels.position)
        x = lower + (upper - lower) * torch.rand(count, 3, generator=generator).to(lower)
        if near:
            index = torch.randint(len(self.surfels), (near,), generator=generator).to(lower.device)
            spread = NEAR_CELLS * self.field.cell * torch.randn(near, 3, generator=generator).to(lower)
            x[:near] = self.surfels.position.detach()[index] + spread
        x = torch.nan_to_num(x, 0.0, 0.0, 0.0)
        f, g = self.field.evaluate(x)
        return Points(x, f, g, near)

    @cached_property
    def cover(self) -> Tensor:
        """Mask (h, w) in 0..1, or the render's alpha where there is none."""
        mask = self.view.cover()
        return self.step.rendered.alpha.detach() if mask is None else mask

    @cached_property
    def rays(self) -> Rays:
        """Rays inside the mask, in proportion to its edges where the profile wants that, and around it."""
        generator, count = self.step.generator, self.settings.rays
        cover = self.cover
        inside = (cover > 0.5).to(torch.float32).cpu()
        if self.settings.edges:
            grey = F.pad(self.view.colour().mean(0).cpu()[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
            edge = torch.hypot(grey[1:-1, 2:] - grey[1:-1, :-2], grey[2:, 1:-1] - grey[:-2, 1:-1])
            inside = inside * (1 - self.settings.edges + self.settings.edges * edge / edge.mean().clamp_min(1e-6))
        grown = F.max_pool2d((cover > 0.5).float().cpu()[None, None], 2 * BORDER + 1, 1, BORDER)[0, 0]
        outside = grown * (cover < 0.5).float().cpu()
        parts = []
        for weight, share in ((inside, INSIDE_SHARE), (outside, 1 - INSIDE_SHARE)):
            flat = weight.flatten()
            if float(flat.sum()) > 0:
                parts.append(torch.multinomial(flat, max(1, round(share * count)), replacement=True, generator=generator))
        if not parts:
            parts.append(torch.randint(cover.numel(), (count,), generator=generator))
        pixel = torch.cat(parts).to(cover.device)
        lower, upper = self.field.lower.to(cover), self.field.upper.to(cover)
        return make_rays(self.view, pixel, lower, upper)

    @cached_property
    def splat_depth(self) -> Tensor:
        """Expected depth (m,) of the surfels on the rays, with gradients to them; 0 where they show nothing."""
        out, pixel = self.step.rendered, self.rays.pixel
        depth, alpha = out.depth.flatten()[pixel], out.alpha.flatten()[pixel]
        return torch.where(alpha > 0.5, depth / alpha.clamp_min(0.5), torch.zeros_like(depth))

    @cached_property
    def splat_normal(self) -> Tensor:
        """Unit blended normals (m, 3) of the surfels on the rays, with gradients to them."""
        normal = self.step.rendered.features[-3:].flatten(1)[:, self.rays.pixel].T
        return F.normalize(normal, dim=1, eps=1e-6)

    @cached_property
    def covered(self) -> Tensor:
        """Mask (m,) in 0..1 on the rays."""
        return self.cover.flatten()[self.rays.pixel]

    @cached_property
    def march(self) -> March:
        """Samples of the field along the rays."""
        field, rays, settings = self.field, self.rays, self.settings
        with torch.no_grad():
            if settings.sampling == "surfels":
                centre = self.splat_depth.detach()
                known = centre > 0
                off = field.value(rays.at(centre[:, None])[:, 0]).abs()
            else:
                centre, known = sphere_trace(field, rays)
                off = torch.zeros_like(centre)
            half = (BAND * off).clamp_min(MIN_BAND_CELLS * field.cell) / rays.length
            z = sample_depths(rays, settings.ray_samples, centre, half, known, self.step.generator)
        return march(rays, z, settings.renderer, field.sharpness(self.step.share), field.evaluate)
