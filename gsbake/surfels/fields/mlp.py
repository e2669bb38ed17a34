"""A network of the position alone, with Fourier features (Tancik et al., NeurIPS 2020), as GS-Pull, NeuS and VolSDF use it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsbake.surfels.fields.encoded import EncodedField


class MlpField(EncodedField):
    """Fourier features and network."""

    name = "mlp"

    def _make_encoding(self, generator: torch.Generator) -> int:
        self.table = torch.zeros(0, 1)
        return 6 * self.settings.octaves

    def _encode(self, points: Tensor) -> tuple[Tensor, Tensor]:
        half = (self.upper - self.lower).to(points) / 2
        x = (points - self.lower.to(points)) / half - 1
        features, jacobian = [points[:, :0]], [points.new_zeros(len(points), 3, 0)]
        for octave in range(self.settings.octaves):
            # half a period over the box at the lowest octave; higher ones weigh less, so that the start is smooth
            frequency, weight = math.pi / 2 * 2**octave, 2.0**-octave
            sine, cosine = torch.sin(frequency * x), torch.cos(frequency * x)
            slope = weight * frequency / half
            features += [weight * sine, weight * cosine]
            jacobian += [torch.diag_embed(slope * cosine), torch.diag_embed(-slope * sine)]
        return torch.cat(features, 1), torch.cat(jacobian, 2)
