"""A multi-resolution hash grid with a small network (Müller et al., SIGGRAPH 2022), as 3DGSR, GSDF and SplatSDF use it.

Resolutions grow geometrically from `COARSEST` cells to `field.resolution`. Levels that fit the table are dense; with a table large enough
for all of them this is the multi-resolution grid of UGSDF. With `field.splats` the nearest surfels add embeddings of their attributes to
the features, weighted by distance (Li et al., *SplatSDF*, 2024).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from gsbake.surfels.fields.encoded import EncodedField
from gsbake.surfels.fields.interpolation import interpolate
from gsbake.surfels.fields.levels import DENSE, HASHED, Level, Levels
from gsbake.surfels.fields.splat_embedding import SplatEmbedding
from gsbake.surfels.model import Surfels

#: Cells per axis of the coarsest level.
COARSEST = 8
#: Half-width of the uniform initial features.
INITIAL = 1e-4
#: Shares of the run at which the anchors of the embeddings are renewed.
RENEWALS = (0.2, 0.45, 0.7)


class HashField(EncodedField):
    """Hash grid and network."""

    name = "hash"

    def _make_encoding(self, generator: torch.Generator) -> int:
        settings = self.settings
        rows = 1 << settings.table_bits
        growth = (max(settings.resolution, COARSEST) / COARSEST) ** (1 / max(1, settings.levels - 1))
        levels = []
        for i in range(settings.levels):
            n = int(np.floor(COARSEST * growth**i + 1e-6)) + 1
            levels.append(Level((n, n, n), DENSE, n**3) if n**3 <= rows else Level((n, n, n), HASHED, rows))
        self.levels = Levels(self.lower.numpy(), self.upper.numpy(), tuple(levels))
        self.table = INITIAL * (2 * torch.rand(self.levels.rows, settings.features, generator=generator) - 1)
        features = settings.levels * settings.features
        self.splats = SplatEmbedding(features, generator) if settings.splats else None
        self.renewals = 0
        self.surfels: Surfels | None = None
        return int(features)

    def _encode(self, points: Tensor) -> tuple[Tensor, Tensor]:
        features, jacobian = interpolate(points, self.table, self.levels)
        if self.splats is not None:
            more, slope = self.splats(points)
            features, jacobian = features + more, jacobian + slope
        return features, jacobian

    def follow(self, surfels: Surfels) -> None:
        """Read the embeddings from these surfels."""
        super().follow(surfels)
        self.surfels = surfels
        if self.splats is not None and not len(self.splats.anchors):
            self.splats.renew(surfels)

    def advance(self, share: float) -> bool:
        """Renew the anchors of the embeddings."""
        due = sum(share >= at for at in RENEWALS)
        if self.splats is not None and self.surfels is not None and due > self.renewals:
            self.splats.renew(self.surfels)
        self.renewals = due
        return False

    def own_parameters(self) -> dict[str, Tensor]:
        """Table, network, and the network of the embeddings."""
        more = {} if self.splats is None else {f"splats.{k}": v for k, v in self.splats.network.weights.items()}
        return super().own_parameters() | more

    def own_tensors(self) -> dict[str, Tensor]:
        """As of every encoded field, and the anchors."""
        own = super().own_tensors() | {"renewals": torch.tensor([self.renewals])}
        if self.splats is None:
            return own
        e = self.splats
        own |= {f"splats.{k}": v for k, v in e.network.weights.items()}
        return own | {"anchors": e.anchors, "anchor_attributes": e.attributes, "anchor_spacing": e.spacing}

    def load_own(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `own_tensors` returned."""
        surfels = getattr(self, "surfels", None)
        super().load_own(tensors)
        self.renewals, self.surfels = int(tensors["renewals"]), surfels
        if self.splats is not None:
            self.splats.network.weights = {k.removeprefix("splats."): v.contiguous() for k, v in tensors.items() if k.startswith("splats.")}
            self.splats.set(tensors["anchors"], tensors["anchor_attributes"], tensors["anchor_spacing"])
