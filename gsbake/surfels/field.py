"""Interface of a signed distance field that surfels are trained with.

Trainer, initialisation, densification, pruning, early stopping, checkpoints and mesh extraction ask a field and nothing else, so that
another representation is one module and one entry in `gsbake.surfels.fields.registry`. Distances are in the unit frame, negative inside.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.rasterise import Rendered
from gsbake.surfels.views import TrainView

#: Slope below which a gradient has no direction.
MIN_SLOPE = 1e-6
#: Points evaluated at once where no gradient is asked for: bounds the memory of the features.
CHUNK = 1 << 17


@dataclass(frozen=True)
class TrainingStep:
    """What the losses of a field read of one step.

    `surfels`, what was `rendered` of them in the step's view, the `share` of the run that is done, whether the losses of the distance have
    begun (`late`), the `generator` of all random numbers, and the training `views` at the size of this step.
    """

    surfels: Surfels
    rendered: Rendered
    share: float
    late: bool
    generator: torch.Generator
    views: Sequence[TrainView] = ()


class Field(ABC):
    """A signed distance field beside surfels."""

    #: Name in the registry and in profiles.
    name: ClassVar[str]
    #: Share of surfels added where the zero level set has none, at each densification.
    seeds: float = 0.0
    #: Times that all surfels are placed anew on the zero level set.
    cycles: int = 0

    def follow(self, surfels: Surfels) -> None:
        """Take notice that these are the surfels from now on (after initialisation, densification, pruning, a resumed run)."""
        return

    @abstractmethod
    def distance(self, surfels: Surfels) -> Tensor:
        """Signed distance (n,) at the centres of the surfels, with gradients to whatever it depends on."""

    def opacity(self, surfels: Surfels) -> Tensor:
        """Opacity (n,) of the surfels, with gradients to whatever it depends on."""
        return surfels.opacity()

    @abstractmethod
    def value(self, points: Tensor) -> Tensor:
        """Signed distance (n,) at points (n, 3)."""

    @abstractmethod
    def gradient(self, points: Tensor) -> Tensor:
        """Gradient (n, 3) of the distance at points (n, 3)."""

    def project(self, points: Tensor) -> Tensor:
        """Points (n, 3) moved to the zero level set to first order: x − f ∇f / ‖∇f‖²; points without a slope stay."""
        f, g = self.value(points), self.gradient(points)
        slope = (g * g).sum(1, keepdim=True)
        return torch.where(slope > MIN_SLOPE, points - f[:, None] * g / slope.clamp_min(MIN_SLOPE), points)

    def project_surfels(self, surfels: Surfels) -> Tensor:
        """Centres (n, 3) of the surfels moved to the zero level set."""
        return self.project(surfels.position)

    @abstractmethod
    def sample_near_zero(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """At most `count` random points (n, 3) on the zero level set, evenly spread over it, and the outward unit normals (n, 3) there."""

    @abstractmethod
    def losses(self, step: TrainingStep, view: TrainView) -> Tensor | None:
        """Weighted sum of what the field asks for in this step; None for nothing."""

    def parameters(self) -> dict[str, Tensor]:
        """Tensors that the optimiser updates in place, by name; without those of the surfels."""
        return {}

    def rates(self) -> dict[str, float]:
        """Learning rate of each of `parameters()` at the start of the run."""
        return {}

    def advance(self, share: float) -> bool:
        """Do what the field's schedule wants at this share of the run, such as a finer resolution; True when the shapes of `parameters()`
        have changed, so that the optimiser forgets their moments."""
        return False

    def settle(self, surfels: Surfels) -> None:
        """Write the current distances into `surfels.sdf`, so that they can be rendered and saved without the field."""
        return

    def state(self) -> dict[str, Any]:
        """The state for a checkpoint."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        return

    @abstractmethod
    def mesh(self, lattice: BlockLattice, truncation: float) -> NDArray[np.float32]:
        """The field (n, 8, 8, 8) on the lattice's blocks in units of `truncation`, clamped to ±1; NaN where it is unknown."""
