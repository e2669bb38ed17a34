"""Shading taken out of projected colours, without fitting materials: one even-handed guess at the light, in seconds.

For matt things only. A texel's colour is c = ρ · a · E(n): paint, openness to ambient light, and the irradiance of a distant white light,

    E(n) = 1 + Σ_k e_k Y_k(n),   Y: the eight spherical harmonics of orders 1 and 2

(Ramamoorthi & Hanrahan, *On the relationship between radiance and irradiance*, JOSA A 2001: higher orders hardly reach a diffuse
surface). Neighbours of one chromaticity are mostly of one paint, whatever way they face, so over all such pairs

    Σ w |log c_i/c_j − log a_i/a_j − log E(n_i)/E(n_j)|

is least for the true light: light that changes is neutral while paint that changes mostly changes its hue as well (Retinex with
chromaticity edges: Grosse et al., *Ground truth dataset and baseline evaluations for intrinsic image algorithms*, ICCV 2009). The absolute
values leave the borders of paints that do differ in brightness alone to themselves. Gauss-Newton, reweighted.

How bright the light is cannot be known: half of the surface gets darker and half brighter than in the photos, and nothing brighter than
white paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.shading.environment import EnvironmentLight

Floats = NDArray[np.float64]

#: Pairs are among this many nearest points and within this share of the diagonal.
NEIGHBOURS, REACH = 24, 0.04
#: Chromaticities (logarithms) this far apart are those of two paints; added to linear colours before the logarithm.
SAME_CHROMA, DARK = 0.05, 0.004
#: Differences of logarithms below this are noise.
NOISE = 0.03
#: Price on the squares of the coefficients, rounds of reweighting, and the share of a step that one round takes.
RIDGE, ROUNDS, STEP = 1e-4, 20, 0.7
#: The irradiance found is kept within this factor of its mean.
STRONGEST = 3.0
#: Openness below this counts as this: light from the object itself fills closed places, and photos show them least surely.
CLOSED = 0.5
#: This share of the surface is to be no brighter than white paper.
NEARLY_ALL, PAPER = 0.995, 0.9


@dataclass(frozen=True)
class Irradiance:
    """`coefficients` (8,) of the irradiance over its mean, in the order of `harmonics`."""

    coefficients: Floats

    def at(self, normal: NDArray[Any]) -> Floats:
        """Irradiance over its mean (n,) at unit normals (n, 3), within `STRONGEST`."""
        return np.clip(1 + harmonics(normal) @ self.coefficients, 1 / STRONGEST, STRONGEST)

    def light(self, size: int, level: float) -> EnvironmentLight:
        """A white environment, cube map of edge `size`, that gives this irradiance (over π) times `level`, as far as positive light can."""
        order = np.array([1.5] * 3 + [4.0] * 5)  # π over the cosine lobe's own coefficients 2π/3 and π/4

        def radiance(directions: Floats) -> Floats:
            value = level * np.maximum(1 + harmonics(directions) @ (order * self.coefficients), 0)
            return np.repeat(value[:, None], 3, 1)

        return EnvironmentLight.from_function(radiance, size)


def harmonics(direction: NDArray[Any]) -> Floats:
    """Spherical harmonics (n, 8) of orders 1 and 2 at unit directions (n, 3), not normalised: x, y, z, xy, yz, zx, x²−y², 3z²−1."""
    x, y, z = np.asarray(direction, np.float64).T
    return np.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)


def find_irradiance(colour: NDArray[Any], normal: NDArray[Any], position: NDArray[Any], openness: NDArray[Any]) -> Irradiance:
    """The light under which n points of the surface are painted most evenly; even light where pairs of them tell nothing.

    `colour` (n, 3) linear, `normal` (n, 3) unit, `position` (n, 3), `openness` (n,) 0..1.
    """
    a, b = _pairs(np.asarray(position, np.float64))
    logs = np.log(np.maximum(colour, 0).astype(np.float64) + DARK)
    brightness = logs.mean(1)
    chroma = logs - brightness[:, None]
    weight = np.exp(-((np.linalg.norm(chroma[a] - chroma[b], axis=1) / SAME_CHROMA) ** 2))
    told = brightness - np.log(np.maximum(openness, CLOSED))
    difference = told[a] - told[b]
    basis = harmonics(normal)
    found = np.zeros(8)
    if not weight.sum() > 0:
        return Irradiance(found)
    ridge = RIDGE * weight.sum()
    for _ in range(ROUNDS):
        value = np.maximum(1 + basis @ found, 1 / STRONGEST)
        relative = basis / value[:, None]
        slope = relative[a] - relative[b]
        rest = difference - np.log(value[a] / value[b])
        w = weight / np.maximum(np.abs(rest), NOISE)
        found = found + STEP * np.linalg.solve((slope * w[:, None]).T @ slope + ridge * np.eye(8), slope.T @ (w * rest) - ridge * found)
    return Irradiance(found)


def without_shading(
    colour: NDArray[Any], normal: NDArray[Any], openness: NDArray[Any], irradiance: Irradiance
) -> tuple[NDArray[np.float32], float]:
    """Base colours (n, 3) of texels that show `colour` (n, 3), and the level of the light that makes these of those."""
    shading = irradiance.at(normal) * np.maximum(openness, CLOSED)
    level = float(1 / np.median(shading)) if len(shading) else 1.0
    base = np.asarray(colour, np.float64) / (level * shading)[:, None]
    brightest = float(np.quantile(base.max(1), NEARLY_ALL)) if len(base) else 0.0
    if brightest > PAPER:
        base, level = base * (PAPER / brightest), level * brightest / PAPER
    return np.clip(base, 0, 1).astype(np.float32), level


def _pairs(position: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (m,), (m,) of points near each other, every pair once."""
    if len(position) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    reach = REACH * float(np.linalg.norm(np.ptp(position, axis=0)))
    count = min(NEIGHBOURS + 1, len(position))
    near = cKDTree(position).query(position, k=count, distance_upper_bound=reach)[1].astype(np.int64)
    own = np.repeat(np.arange(len(position)), count)
    met = near.ravel()
    # A pair that both sides know counts once; one that only the later point knows is kept from its side.
    low, high = np.minimum(own, met), np.maximum(own, met)
    known = (met < len(position)) & (low != high)
    once = np.unique(low[known] * len(position) + high[known])
    return once // len(position), once % len(position)
