"""The environment light of the material fit with its optimiser: Adam (Kingma & Ba 2015) on the parameters of its radiance.

Adam divides each gradient by its own root mean square, so a texel of the light that hardly shows in any photo moves as far each step as
one that decides, in a direction that the noise of single photos gives. Only a learning rate that ends low leaves no speckles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.materials.options import FitOptions
from gsbake.shading.environment import EnvironmentLight


class LightOptimiser:
    """The `light` while it is fitted."""

    def __init__(self, size: int, options: FitOptions) -> None:
        """`size` is the edge of the environment map's faces in texels."""
        self.light, self._options = EnvironmentLight(size), options
        self._adam = torch.optim.Adam([self.light.raw], lr=options.light_rate, betas=options.betas)

    def radiance(self) -> NDArray[np.float32]:
        """The environment map (6, size, size, 3), linear RGB."""
        return np.asarray(self.light.radiance().detach().numpy())

    def step(self, loss: torch.Tensor, decay: float) -> None:
        """One step down the gradient of a `loss` of the light's radiance, with the learning rate times `decay`."""
        self._adam.zero_grad()
        loss.backward()
        self._adam.param_groups[0]["lr"] = self._options.light_rate * decay
        self._adam.step()

    @torch.no_grad()
    def replace(self, radiance: EnvironmentLight | NDArray[Any]) -> None:
        """Set the light to a `radiance` (6, size, size, 3) or to that of another light, and reset the optimiser's moments."""
        other = radiance if isinstance(radiance, EnvironmentLight) else EnvironmentLight.from_radiance(radiance)
        self.light.raw.copy_(other.raw)
        self._adam.state.clear()
