"""The texels of the material fit with their optimiser: Adam (Kingma & Ba 2015) on logits, with the gradients of the priors.

The priors are total variation of materials and squared differences of normal offsets between neighbouring texels, the means of base colour
and metallic, the squared normal offset, and the distance to common materials (see `fit`).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.materials import fit_kernel
from gsbake.materials.adjacency import neighbour_lists
from gsbake.materials.fit_surface import FitSurface
from gsbake.materials.options import FitOptions, Priors
from gsbake.materials.sparsity_prior import KERNEL_WIDTHS

Floats = NDArray[np.float32]


class TexelOptimiser:
    """Values (n, PARAMETERS) of the texels of a surface, their logits, and the optimiser's moments."""

    def __init__(self, surface: FitSurface, priors: Priors, options: FitOptions, values: Floats) -> None:
        """Start from texel `values` (n, PARAMETERS), all materials within (0, 1)."""
        self._surface, self._priors, self._options = surface, priors, options
        self.values, self._spare = values, np.empty_like(values)
        self._raw = values.copy()
        self._raw[:, :5] = _logit(values[:, :5])
        self._moments = np.zeros_like(values), np.zeros_like(values)
        self._steps = 0

    def step(self, gradient: Floats, residual: float, common: Floats, decay: float, normals: bool = True) -> None:
        """One step on all texels, with learning rates times `decay`, from the `gradient` (n, PARAMETERS) of a photo, which is set to zero.

        `residual` is the mean squared error so far, in units of the robust scale's square, and `common` (n or 0, 4) the common materials
        that the sparsity prior draws to, in proportion to it.
        """
        o, priors, f = self._options, self._priors, np.float32
        self._steps += 1
        start, neighbour = self._adjacency
        pair_weight = len(self._raw) / max(1, len(self._surface.pairs))
        normal_smoothness = o.normal_smoothness * (self._surface.texels.size / 512) ** 2  # the change per texel grows with their size
        smoothness = np.array([*(priors.smoothness * np.array(o.smoothness_channels)), *[normal_smoothness] * 3], f) * f(pair_weight)
        mean_weight = np.array([*[priors.base_color_l1 / 3] * 3, 0, priors.metallic_l1, 0, 0, 0], f)
        common_weight = np.zeros(4, f)
        if len(common):
            common_weight = (priors.sparsity * residual / np.square(KERNEL_WIDTHS)).astype(f)
        rate = np.array([o.texel_rate] * 5 + [o.normal_rate if normals else 0.0] * 3, f) * f(decay)
        beta1, beta2 = o.betas
        fit_kernel.adam_step(
            self._raw, self.values, self._spare, gradient, *self._moments, start, neighbour, smoothness, mean_weight,
            f(o.normal_offset_weight), common, common_weight, rate, f(beta1), f(beta2), f(1 / (1 - beta1**self._steps)),
            f(1 / (1 - beta2**self._steps)), f(o.epsilon),
        )  # fmt: skip
        self.values, self._spare = self._spare, self.values

    def reinitialise(self, texel: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Set the materials of texels (m,) to `values` (m, 5) and reset the optimiser's moments there."""
        self.values[texel, :5] = values
        self._raw[texel, :5] = _logit(self.values[texel, :5])
        for moment in self._moments:
            moment[texel, :5] = 0

    @cached_property
    def _adjacency(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        return neighbour_lists(self._surface.pairs, len(self._raw))


def _logit(values: NDArray[Any]) -> Floats:
    """log(v / (1 − v)) of values in (0, 1)."""
    v = np.asarray(values, np.float64)
    return np.asarray(np.log(v / (1 - v)), np.float32)
