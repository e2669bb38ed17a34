"""Fields whose features a small network turns into a distance: a sphere plus what the network adds to it.

Shared by `tensor`, `hash` and `mlp`, which differ in their encoding alone. The network also reads the position, scaled to the box.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.heads import Network
from gsbake.surfels.fields.known import Known


class EncodedField(ContinuousField):
    """Sphere + network(encoding(x), x)."""

    #: Learning rate of the network's weights.
    network_rate = 1e-3
    #: Learning rate of the encoding's table.
    table_rate = 5e-3

    @abstractmethod
    def _make_encoding(self, generator: torch.Generator) -> int:
        """Create `self.table` and whatever else the encoding needs; the number of features."""

    @abstractmethod
    def _encode(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, f) and their Jacobian (n, 3, f)."""

    def start(self, known: Known, seed: int) -> None:
        """A sphere of the known points' size, then a fit to their distance."""
        generator = torch.Generator().manual_seed(seed)
        if len(known.points):
            centre = known.points.mean(0)
            radius = float(np.linalg.norm(known.points - centre, axis=1).mean())
        else:
            centre, radius = np.zeros(3), float(getattr(known, "radius", 1.0))
        self.sphere = torch.tensor([*centre, radius], dtype=torch.float32)
        self.table = torch.zeros(0, 1)
        features = self._make_encoding(generator)
        self.network = Network(features + 3, self.settings.width, self.settings.hidden, 1 + self._extra_outputs(), generator)
        self.fit(known, seed, self.settings.fit_steps)

    def _extra_outputs(self) -> int:
        return 0

    def _features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Encoding and scaled position (n, f + 3), and their Jacobian (n, 3, f + 3)."""
        features, jacobian = self._encode(points)
        half = (self.upper - self.lower).to(points) / 2
        position = (points - self.lower.to(points)) / half - 1
        slope = torch.diag(1 / half).expand(len(points), 3, 3)
        return torch.cat([features, position], 1), torch.cat([jacobian, slope], 2)

    def _inside(self, points: Tensor) -> tuple[Tensor, Tensor]:
        out, jacobian = self.network.with_jacobian(*self._features(points))
        offset = points - self.sphere[:3].to(points)
        length = offset.norm(dim=1).clamp_min(1e-9)
        f = length - self.sphere[3].to(points) + out[:, 0]
        return f, offset / length[:, None] + jacobian[:, :, 0]

    def own_parameters(self) -> dict[str, Tensor]:
        """Table and network."""
        own = {f"network.{k}": v for k, v in self.network.weights.items()}
        return own | ({"table": self.table} if len(self.table) else {})

    def own_rates(self) -> dict[str, float]:
        """Per tensor."""
        rate = self.settings.rate
        return {k: rate * (self.table_rate if k == "table" else self.network_rate) for k in self.own_parameters()}

    def own_tensors(self) -> dict[str, Tensor]:
        """Box, sphere, table and network."""
        own = {"lower": self.lower, "upper": self.upper, "sphere": self.sphere, "table": self.table}
        return own | {f"network.{k}": v for k, v in self.network.weights.items()}

    def load_own(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `own_tensors` returned."""
        self.lower, self.upper, self.sphere = tensors["lower"], tensors["upper"], tensors["sphere"]
        generator = torch.Generator().manual_seed(0)
        features = self._make_encoding(generator)
        self.network = Network(features + 3, self.settings.width, self.settings.hidden, 1 + self._extra_outputs(), generator)
        self.table = tensors["table"].contiguous()
        self.network.weights = {k.removeprefix("network."): v.contiguous() for k, v in tensors.items() if k.startswith("network.")}
