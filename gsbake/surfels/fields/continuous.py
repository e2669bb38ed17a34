"""What the fields have in common that are defined everywhere in a box: evaluation, start, opacity of surfels, sampling, meshing.

A representation (`grid`, `octree`, `tensor`, `hash`, `mlp`) gives value and gradient inside its box; outside, the distance to the box is
added.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.surfels.adam import Adam
from gsbake.surfels.couplings.combined import combined_losses
from gsbake.surfels.field import CHUNK, Field, TrainingStep
from gsbake.surfels.fields.known import Known
from gsbake.surfels.fields.radiance import Radiance
from gsbake.surfels.model import Surfels
from gsbake.surfels.views import TrainView

#: Width of a marched surface in cells at the start and at the end of a run.
FIRST_WIDTH, LAST_WIDTH = 1.5, 0.25
#: Cells along each side of the lattice on which the zero level set is looked for, and Newton steps onto it.
SEARCH_CELLS, NEWTON_STEPS = 64, 3
#: Points of the fit to the known distance, those of one step, and its rate as a multiple of that of training.
FIT_POINTS, FIT_BATCH, FIT_RATE = 60_000, 4096, 3.0
#: Weight of the gradient's error in that fit.
GRADIENT_WEIGHT = 1.0


class ContinuousField(Field):
    """A field with parameters of its own over the box `lower`..`upper` (3,)."""

    def __init__(self, settings: Any, coupling: Any, loss: Any, box: tuple[NDArray[Any], NDArray[Any]]) -> None:
        """`settings`, `coupling` and `loss` are the profile's sections [field], [coupling] and [loss]."""
        self.settings, self.coupling, self.loss = settings, coupling, loss
        self.seeds, self.cycles = settings.seeds, settings.cycles
        self.lower, self.upper = (torch.tensor(np.asarray(x, np.float32)) for x in box)
        self._at: tuple[Tensor, Tensor] | None = None
        self.radiance: Radiance | None = None
        #: Pixels that rays are drawn from, by photo and width.
        self.pixel_tables: dict[tuple[str, int], Any] = {}

    def make_radiance(self, seed: int) -> None:
        """Colours of the field's own, where a coupling marches them."""
        if self.coupling.colour:
            self.radiance = Radiance(self.lower.numpy(), self.upper.numpy(), seed)

    # -- what a representation defines --------------------------------------------------------------------------------------------

    @abstractmethod
    def _inside(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3) at points (n, 3) in the box: both differentiable by the parameters, the value by the points."""

    @abstractmethod
    def start(self, known: Known, seed: int) -> None:
        """Take the known distance as far as the representation can."""

    @abstractmethod
    def own_parameters(self) -> dict[str, Tensor]:
        """Tensors that are trained, without those of the radiance."""

    @abstractmethod
    def own_rates(self) -> dict[str, float]:
        """Learning rate of each of `own_parameters`."""

    @abstractmethod
    def own_tensors(self) -> dict[str, Tensor]:
        """All tensors, trained or not, from which `load_own` builds the same field."""

    @abstractmethod
    def load_own(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `own_tensors` returned."""

    # -- evaluation ---------------------------------------------------------------------------------------------------------------

    @property
    def cell(self) -> float:
        """Size of the finest cell (unit frame)."""
        return float((self.upper - self.lower).max()) / self.settings.resolution

    def evaluate(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3) at points (n, 3); points that are not finite count as the origin."""
        lower, upper = self.lower.to(points), self.upper.to(points)
        points = torch.where(torch.isfinite(points), points, 0.0)
        held = torch.minimum(torch.maximum(points, lower), upper)
        f, g = self._inside(held)
        away = points - held
        far = away.norm(dim=1)
        outside = (far > 0)[:, None]
        return f + far, torch.where(outside, g + away / far.clamp_min(1e-12)[:, None], g)

    def at_surfels(self, surfels: Surfels) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3) at the surfels' centres; evaluated once per step."""
        if self._at is None or len(self._at[0]) != len(surfels):
            self._at = self.evaluate(surfels.position)
        return self._at

    def follow(self, surfels: Surfels) -> None:
        """Forget the values at the former surfels."""
        self._at = None

    def distance(self, surfels: Surfels) -> Tensor:
        """The value (n,) at the centres."""
        return self.at_surfels(surfels)[0]

    def opacity(self, surfels: Surfels) -> Tensor:
        """Opacity (n,): the surfels' own, or the transfer function of the distance at their centres."""
        if self.settings.opacity == "own":
            return surfels.opacity()
        return surfels.transfer.opacity(self.distance(surfels), surfels.gamma)

    def settle(self, surfels: Surfels) -> None:
        """Write the distances of this step into the surfels' samples, pull the surfels where the profile wants that, and forget them."""
        if self._at is not None and len(self._at[0]) == len(surfels):
            f, g = (x.detach() for x in self._at)
            if self.coupling.pull_surfels:
                slope = g.norm(dim=1).clamp_min(0.1)
                step = (self.coupling.pull_surfels * f / slope).clamp(-self.cell, self.cell)
                surfels.position -= step[:, None] * g / slope[:, None]
            surfels.sdf = f.clone()
        self._at = None

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (n,)."""
        if points.requires_grad or torch.is_grad_enabled():
            return self.evaluate(points)[0]
        return torch.cat([self.evaluate(part)[0] for part in points.split(CHUNK)]) if len(points) else points[:, 0]

    def gradient(self, points: Tensor) -> Tensor:
        """Gradient (n, 3)."""
        return self.evaluate(points)[1]

    @torch.no_grad()
    def sample_near_zero(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Random points of the cells that the zero level set may cross, moved onto it by Newton steps."""
        edge = (self.upper - self.lower) / SEARCH_CELLS
        axes = [self.lower[i] + edge[i] * (torch.arange(SEARCH_CELLS) + 0.5) for i in range(3)]
        centres = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        crossed = centres[self.value(centres).abs() < 0.5 * float(edge.norm())]
        if not len(crossed):
            return centres[:0], centres[:0]
        chosen = torch.randint(len(crossed), (count,), generator=generator)
        points = crossed[chosen] + edge * (torch.rand(count, 3, generator=generator) - 0.5)
        for _ in range(NEWTON_STEPS):
            points = self.project(points)
        f, g = self.evaluate(points)
        slope = g.norm(dim=1)
        fine = (f.abs() < 0.1 * edge.max()) & (slope > 0.1) & (points >= self.lower).all(1) & (points <= self.upper).all(1)
        return points[fine], (g / slope.clamp_min(1e-6)[:, None])[fine]

    @torch.no_grad()
    def mesh(self, lattice: BlockLattice, truncation: float) -> NDArray[np.float32]:
        """The value at every sample; known everywhere."""
        out = np.empty((len(lattice), 8, 8, 8), np.float32)
        step = CHUNK // 512
        for start in range(0, len(lattice), step):
            part = slice(start, min(len(lattice), start + step))
            points = torch.from_numpy(lattice.positions(part).reshape(-1, 3).astype(np.float32))
            out[part] = self.value(points).numpy().reshape(-1, 8, 8, 8)
        return np.clip(out / np.float32(truncation), -1, 1)

    # -- training -----------------------------------------------------------------------------------------------------------------

    def losses(self, step: TrainingStep, view: TrainView) -> Tensor | None:
        """The couplings of the profile; see `gsbake.surfels.couplings`."""
        return combined_losses(self, step, view, self.loss, self.coupling)

    def fit(self, known: Known, seed: int, steps: int) -> None:
        """Fit the parameters to the known distance (L1, in spacings) and its gradient (L1) at points near the surface and all over the box.

        Without the gradient a field with many parameters meets the distances by a rough function, whose slope has no meaning."""
        if not steps:
            return
        rng = np.random.default_rng(seed)
        lower, upper = self.lower.numpy().astype(float), self.upper.numpy().astype(float)
        points = rng.uniform(lower, upper, (FIT_POINTS // 3 if len(known.points) else FIT_POINTS, 3))
        if len(known.points):
            near = known.points[rng.integers(len(known.points), size=FIT_POINTS - len(points))]
            spread = np.repeat([1.0, 4.0], [len(near) // 2, len(near) - len(near) // 2])[:, None] * known.spacing
            points = np.concatenate([points, near + spread * rng.normal(size=near.shape)])
        x = torch.from_numpy(points.astype(np.float32))
        target, slope = (torch.from_numpy(known_at) for known_at in known.with_gradient(points))
        adam, generator = Adam(), torch.Generator().manual_seed(seed)
        parameters, rates = self.own_parameters(), self.own_rates()
        for done in range(steps):
            batch = torch.randint(len(x), (FIT_BATCH,), generator=generator)
            for p in parameters.values():
                p.requires_grad_()
                p.grad = None
            f, g = self.evaluate(x[batch])
            ((f - target[batch]).abs().mean() / known.spacing + GRADIENT_WEIGHT * (g - slope[batch]).abs().sum(1).mean()).backward()
            for name, p in parameters.items():
                if p.grad is not None:
                    adam.step(name, p.data, p.grad, FIT_RATE * rates[name] * 0.1 ** (done / steps))
                p.requires_grad_(False)

    def sharpness(self, share: float) -> Tensor:
        """Sharpness γ of marched rays at this share of the run: the weights' width falls from `FIRST_WIDTH` to `LAST_WIDTH` cells."""
        width = FIRST_WIDTH ** (1 - share) * LAST_WIDTH**share
        return torch.tensor(1 / (width * self.cell))

    def parameters(self) -> dict[str, Tensor]:
        """Those of the representation and of the radiance."""
        colours = {} if self.radiance is None else {f"radiance.{k}": v for k, v in self.radiance.parameters().items()}
        return self.own_parameters() | colours

    def rates(self) -> dict[str, float]:
        """Rates of the same."""
        colours = {} if self.radiance is None else {f"radiance.{k}": v for k, v in self.radiance.rates().items()}
        return self.own_rates() | colours

    def state(self) -> dict[str, Any]:
        """All tensors."""
        colours = {} if self.radiance is None else {f"radiance.{k}": v for k, v in self.radiance.parameters().items()}
        return self.own_tensors() | colours

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.load_own({k: v for k, v in state.items() if not k.startswith("radiance.")})
        colours = {k.removeprefix("radiance."): v for k, v in state.items() if k.startswith("radiance.")}
        if colours:
            self.radiance = self.radiance or Radiance(self.lower.numpy(), self.upper.numpy(), 0)
            self.radiance.load_tensors(colours)
        self._at = None
