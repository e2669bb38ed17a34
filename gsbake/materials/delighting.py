"""Delighting: shading removed from projected colours of a diffuse object, with one low-order environment, in seconds.

A texel's colour is c = ρ · a · E(n): albedo, ambient occlusion, and the irradiance of a distant white environment,

    E(n) = 1 + Σ_k e_k Y_k(n),   Y: the eight spherical harmonics of orders 1 and 2

(Ramamoorthi & Hanrahan, *On the relationship between radiance and irradiance*, JOSA A 2001: a diffuse surface hardly reflects higher
orders). Neighbours of one chromaticity mostly have one albedo, whatever their orientation, so over all such pairs

    Σ w |log c_i/c_j − log a_i/a_j − log E(n_i)/E(n_j)|

is minimal for the true light: shading changes are neutral while albedo changes mostly change hue (Retinex with chromaticity edges: Grosse
et al., *Ground truth dataset and baseline evaluations for intrinsic image algorithms*, ICCV 2009). The L1 norm tolerates albedo edges that
differ in brightness alone. Gauss-Newton with iteratively reweighted least squares.

The light's intensity is not observable: the median shading is set to 1, and no albedo may exceed that of white paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.shading.environment import EnvironmentLight

Floats = NDArray[np.float64]

#: Pairs are formed with this many nearest points, within this share of the bounding-box diagonal.
NEIGHBOURS, NEIGHBOUR_RADIUS = 24, 0.04
#: Scale of log-chromaticity differences above which two albedos are assumed; offset added to linear colours before the logarithm.
CHROMATICITY_SCALE, LOG_OFFSET = 0.05, 0.004
#: Differences of logarithms below this are noise.
NOISE_FLOOR = 0.03
#: Ridge weight on the squared coefficients, rounds of reweighting, and damping factor of a Gauss-Newton step.
RIDGE, ROUNDS, DAMPING = 1e-4, 20, 0.7
#: The irradiance is clamped to within this factor of its mean.
MAX_IRRADIANCE_RATIO = 3.0
#: Lower bound of ambient occlusion: indirect light fills cavities, and photos show them least reliably.
MIN_OCCLUSION = 0.5
#: This quantile of albedo is at most that of white paper.
ALBEDO_QUANTILE, MAX_ALBEDO = 0.995, 0.9


@dataclass(frozen=True)
class Irradiance:
    """`coefficients` (8,) of the irradiance over its mean, in the order of `harmonics`."""

    coefficients: Floats

    def at(self, normal: NDArray[np.floating]) -> Floats:
        """Irradiance over its mean (n,) at unit normals (n, 3), clamped to `MAX_IRRADIANCE_RATIO`."""
        return np.clip(1 + harmonics(normal) @ self.coefficients, 1 / MAX_IRRADIANCE_RATIO, MAX_IRRADIANCE_RATIO)

    def light(self, size: int, intensity: float) -> EnvironmentLight:
        """A white environment, cube map of edge `size`, with this irradiance (over π) times `intensity`; negative radiance is clamped."""
        order = np.array([1.5] * 3 + [4.0] * 5)  # π over the cosine lobe's own coefficients 2π/3 and π/4

        def radiance(directions: Floats) -> Floats:
            value = intensity * np.maximum(1 + harmonics(directions) @ (order * self.coefficients), 0)
            return np.repeat(value[:, None], 3, 1)

        return EnvironmentLight.from_function(radiance, size)


def harmonics(direction: NDArray[np.floating]) -> Floats:
    """Spherical harmonics (n, 8) of orders 1 and 2 at unit directions (n, 3), not normalised: x, y, z, xy, yz, zx, x²−y², 3z²−1."""
    x, y, z = np.asarray(direction, np.float64).T
    return np.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)


def find_irradiance(
    colour: NDArray[np.floating], normal: NDArray[np.floating], position: NDArray[np.floating], occlusion: NDArray[np.floating]
) -> Irradiance:
    """The irradiance that best explains the differences between n points of the surface; uniform without usable pairs.

    `colour` (n, 3) linear, `normal` (n, 3) unit, `position` (n, 3), `occlusion` (n,) ambient occlusion, 1 = open.
    """
    a, b = nearby_pairs(np.asarray(position, np.float64), NEIGHBOURS, NEIGHBOUR_RADIUS)
    logs = np.log(np.maximum(colour, 0).astype(np.float64) + LOG_OFFSET)
    brightness = logs.mean(1)
    chroma = logs - brightness[:, None]
    weight = np.exp(-((np.linalg.norm(chroma[a] - chroma[b], axis=1) / CHROMATICITY_SCALE) ** 2))
    unoccluded = brightness - np.log(np.maximum(occlusion, MIN_OCCLUSION))
    difference = unoccluded[a] - unoccluded[b]
    basis = harmonics(normal)
    found = np.zeros(8)
    if not weight.sum() > 0:
        return Irradiance(found)
    ridge = RIDGE * weight.sum()
    for _ in range(ROUNDS):
        value = np.maximum(1 + basis @ found, 1 / MAX_IRRADIANCE_RATIO)
        relative = basis / value[:, None]
        slope = relative[a] - relative[b]
        rest = difference - np.log(value[a] / value[b])
        w = weight / np.maximum(np.abs(rest), NOISE_FLOOR)
        found = found + DAMPING * np.linalg.solve((slope * w[:, None]).T @ slope + ridge * np.eye(8), slope.T @ (w * rest) - ridge * found)
    return Irradiance(found)


def remove_shading(
    colour: NDArray[np.floating], normal: NDArray[np.floating], occlusion: NDArray[np.floating], irradiance: Irradiance
) -> tuple[NDArray[np.float32], float]:
    """Base colours (n, 3) of texels with the projected `colour` (n, 3), and the light intensity that belongs to them."""
    shading = irradiance.at(normal) * np.maximum(occlusion, MIN_OCCLUSION)
    intensity = float(1 / np.median(shading)) if len(shading) else 1.0
    base = np.asarray(colour, np.float64) / (intensity * shading)[:, None]
    brightest = float(np.quantile(base.max(1), ALBEDO_QUANTILE)) if len(base) else 0.0
    if brightest > MAX_ALBEDO:
        base, intensity = base * (MAX_ALBEDO / brightest), intensity * brightest / MAX_ALBEDO
    return np.clip(base, 0, 1).astype(np.float32), intensity


def nearby_pairs(position: Floats, neighbours: int, radius_share: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (m,), (m,) of points at `position` (n, 3) that are among the nearest `neighbours` of one another within `radius_share` of the
    diagonal, every pair once."""
    if len(position) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    radius = radius_share * float(np.linalg.norm(np.ptp(position, axis=0)))
    count = min(neighbours + 1, len(position))
    near = cKDTree(position).query(position, k=count, distance_upper_bound=radius)[1].astype(np.int64)
    own = np.repeat(np.arange(len(position)), count)
    other = near.ravel()
    # The relation is not symmetric: a pair that either point found is taken once.
    low, high = np.minimum(own, other), np.maximum(own, other)
    valid = (other < len(position)) & (low != high)
    once = np.unique(low[valid] * len(position) + high[valid])
    return once // len(position), once % len(position)
