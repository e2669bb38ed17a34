"""Noise of metals' base colours, and the filter that takes it out: Lee's filter over similar neighbours on the surface.

Normals are some degrees off and so is the light, texel by texel of it; both move reflections, and a metal's base colour, which only
reflections show, varies with them from place to place. How much of a variation is noise two halves of the photos tell: base colours solved
from each differ by noise alone, and what both share varies with the material. With a local mean m, a local variance V of the base colour b,
and N that of the noise,

    b' = m + max(0, 1 − N / V) (b − m)

which keeps a print whose halves agree and smooths bare metal, whose halves do not (J.-S. Lee, *Digital image enhancement and noise
filtering by use of local statistics*, PAMI 1980). Values are sRGB. Dielectrics have little of this noise: photos show their base colour
itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode, encode
from gsbake.materials.descent import Steps, descend
from gsbake.materials.linear_shading import BaseColourSolver, PhotoSamples, observed_weight
from gsbake.materials.passes import Rule, Scene
from gsbake.materials.state import State
from gsbake.materials.surface import EdgeAwareFilter, Materials
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MetalNoise(Rule):
    """Takes out of metals' base colours the noise that two halves of the photos tell; texels and light then adapt in the gradient `steps`,
    if there are some."""

    steps: Steps | None = None

    def applies(self, scene: Scene, state: State) -> bool:
        """Not on a diffuse object, nor where the light moves: metals adapt to the errors of that, which is an approximation."""
        return not scene.diffuse and not state.level.moving

    def run(self, scene: Scene, state: State) -> State:
        """Base colours of metals without noise."""
        metal, surface, m = state.metal & state.emits_nothing, state.level.surface, state.materials
        halves = [state.metal_samples(slice(first, None, 2)) for first in range(2)]
        base, texel = without_noise(halves, m, metal, surface.texels, surface.pairs), np.flatnonzero(metal)
        state = state.with_inside(texel, replace(m.of(texel), base_color=base[texel].astype(np.float32))).with_transport()
        return descend(scene, state, self.steps, scene.each("trials of metal and dielectric")) if self.steps else state


@dataclass(frozen=True)
class NoiseOptions:
    """Constants of the filter of noise."""

    #: Change of base colour (sRGB, sum of channels) between adjacent texels over which a neighbourhood extends.
    scale: float = 0.5
    #: Weights and variances below are none.
    tiny: float = 1e-6


OPTIONS = NoiseOptions()

#: Weight of unclipped pixels in each half from which a texel's noise is measured; least share of metal for it to be filtered.
MIN_WEIGHT, MIN_SHARE = 0.15, 0.01


def without_noise(
    halves: Sequence[Sequence[PhotoSamples]], materials: Materials, metal: NDArray[np.bool_], texels: Texels, pairs: NDArray[np.int64]
) -> Floats:
    """Linear base colours (n, 3): those of `metal` (n,) without the noise that two `halves` of the photos tell.

    `materials` are those of the `texels` with neighbouring `pairs` (m, 2).
    """
    base = np.asarray(materials.base_color, np.float64)
    if metal.mean() < MIN_SHARE or not all(halves):
        return base
    colour, weight = encode(np.clip(base, 0, 1)).astype(np.float64), observed_weight([*halves[0], *halves[1]], len(base)) * metal
    noise, measured = _noise(halves, np.ascontiguousarray(materials.roughness))
    near = EdgeAwareFilter(texels, pairs, np.where(metal[:, None], colour, 0).astype(np.float32), OPTIONS.scale)
    mean = _mean(near, colour, weight)
    variance = _mean(near, np.square(colour - mean), weight)
    share = np.clip(1 - _mean(near, noise, weight * measured) / np.maximum(variance, OPTIONS.tiny), 0, 1)
    return np.where(metal[:, None], decode(np.clip(mean + share * (colour - mean), 0, 1)), base)


def _noise(halves: Sequence[Sequence[PhotoSamples]], roughness: NDArray[np.float32]) -> tuple[Floats, NDArray[np.bool_]]:
    """Variance (n, 3) of the noise of metals' base colours in sRGB from all photos, a quarter of the squared difference of those from each
    of the `halves`, and where it is measured (n,)."""
    solved, measured = [], np.ones(len(roughness), bool)
    for half in halves:
        shadings = [samples.shade(roughness).metal for samples in half]
        solved.append(encode(BaseColourSolver(half, len(roughness)).solve(shadings, robust=True)))
        measured &= observed_weight(half, len(roughness)) > MIN_WEIGHT
    return np.asarray(np.square(solved[0] - solved[1]) / 4, np.float64), measured


def _mean(near: EdgeAwareFilter, values: Floats, weight: Floats) -> Floats:
    """Weighted means (n, c) of `values` (n, c) over the neighbourhoods of `near`."""
    total = near(weight)
    return np.stack([near(weight * column) for column in values.T], 1) / np.maximum(total, OPTIONS.tiny)[:, None]
