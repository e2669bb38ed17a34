"""What couplings read in one step, computed once and only when asked for: the field at the surfels, at random points and along rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.surfels.couplings.coupled_field import CoupledField
from gsbake.surfels.couplings.ray_marching import March, Rays, make_rays, march, sample_depths, sphere_trace
from gsbake.surfels.couplings.ray_pixels import pixel_table
from gsbake.surfels.field import TrainingStep
from gsbake.surfels.raster.kernel import AUX_PLANES
from gsbake.surfels.spacing import typical_spacing
from gsbake.surfels.views import TrainView

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

    def __init__(self, field: CoupledField, step: TrainingStep, view: TrainView) -> None:
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
        view, cover = self.view, self.cover
        tables, key = self.field.pixel_tables, (view.name, view.pinhole.width)
        table = tables.get(key) if view.mask is not None else None
        if table is None:
            table = pixel_table(view, cover, self.settings.edges)
            if view.mask is not None:
                tables[key] = table
        pixel = table.draw(self.settings.rays, self.step.generator).to(cover.device)
        return make_rays(view, pixel, self.field.lower.to(cover), self.field.upper.to(cover))

    @cached_property
    def _splats(self) -> Tensor:
        """Blended normals, depth and alpha (5, m) on the rays: one gather, since each costs the backward pass a copy of all planes."""
        planes = self.step.rendered.planes
        c = planes.shape[0] - AUX_PLANES
        rows = torch.tensor([c - 3, c - 2, c - 1, c, c + 4], device=planes.device)
        return planes.flatten(1)[rows[:, None], self.rays.pixel]

    @cached_property
    def splat_depth(self) -> Tensor:
        """Expected depth (m,) of the surfels on the rays, with gradients to them; 0 where they show nothing."""
        depth, alpha = self._splats[3], self._splats[4]
        return torch.where(alpha > 0.5, depth / alpha.clamp_min(0.5), torch.zeros_like(depth))

    @cached_property
    def splat_normal(self) -> Tensor:
        """Unit blended normals (m, 3) of the surfels on the rays, with gradients to them."""
        return F.normalize(self._splats[:3].T, dim=1, eps=1e-6)

    @cached_property
    def covered(self) -> Tensor:
        """Mask (m,) in 0..1 on the rays."""
        return self.cover.flatten()[self.rays.pixel]

    @cached_property
    def march(self) -> March:
        """Samples of the field along the rays."""
        field, rays, settings = self.field, self.rays, self.settings
        depth = self.splat_depth  # cached with its gradient, so outside of what follows
        with torch.no_grad():
            if settings.sampling == "surfels":
                centre = depth.detach()
                known = centre > 0
                off = field.value(rays.at(centre[:, None])[:, 0]).abs()
            else:
                centre, known = sphere_trace(field.value, rays)
                off = torch.zeros_like(centre)
            half = (BAND * off).clamp_min(MIN_BAND_CELLS * field.cell) / rays.length
            z = sample_depths(rays, settings.ray_samples, centre, half, known, self.step.generator)
        return march(rays, z, settings.renderer, field.sharpness(self.step.share), field.evaluate)
