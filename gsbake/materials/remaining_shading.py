"""Shading in colours of a surface, found by comparing its points: in photos' colours (delighting), and what a fit has left in base colours.

A colour is c = ρ · a · E(n): base colour, ambient occlusion, and the irradiance of a distant environment, whose logarithm is

    log E(n) = Σ_k e_k Y_k(n),   Y: the eight spherical harmonics of orders 1 and 2

in each channel (Ramamoorthi & Hanrahan, *On the relationship between radiance and irradiance*, JOSA A 2001: a diffuse surface hardly
reflects higher orders). Photos of a rough object under one light fit as well with shading in the base colours as in the light, but most
objects have few base colours, whatever their orientation. So the shading is where

    Σ_ij w_ij |log c_i/c_j − Σ_k e_k (Y_k(n_i) − Y_k(n_j))| + ridge |e|²

is least over pairs of points, half of them near each other and half anywhere on the object. Weights w_ij fall with the difference of
chromaticity and of brightness that is left (Geman–McClure), so that pairs of different base colours do not take part (Retinex with
chromaticity: Grosse et al., *Ground truth dataset and baseline evaluations for intrinsic image algorithms*, ICCV 2009; global sparsity of
reflectance: Gehler et al., *Recovering intrinsic images with a global sparsity prior on reflectance*, NIPS 2011). Gauss-Newton with
iteratively reweighted least squares.

That is not convex: where shading is strong, pairs across it look like different base colours and drop out before it is found. So it is
solved twice, once with scales that start wide (graduated non-convexity: Blake & Zisserman, *Visual Reconstruction*, 1987), and the
solution with which more pairs agree is taken; the wide one must win clearly, as it may take a base colour that varies with the normal
for shading. What is left after such a solution is weak, and not looked for with wide scales again.

Delighting compares near points only, under one white light whose irradiance E(n) = 1 + Σ_k e_k Y_k(n) itself is of low order. Its intensity
is not observable: the median shading is set to 1, and no base colour may exceed that of white paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.kernels.declaration import kernel
from gsbake.materials.descent import Steps, descend
from gsbake.materials.passes import Rule, Scene
from gsbake.materials.state import State
from gsbake.shading.cubemap import directions
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import irradiance

Doubles = NDArray[np.float64]

#: Points that are compared, each with so many others anywhere, and with so many of the nearest within this share of the diagonal.
POINTS, PARTNERS, NEIGHBOURS, NEIGHBOUR_RADIUS = 4000, 64, 48, 0.15
#: Difference of log chromaticity from which two base colours are taken as different; the same of log brightness, anywhere and nearby.
CHROMATICITY_SCALE, BRIGHTNESS_SCALE, NEARBY_BRIGHTNESS_SCALE = 0.06, 0.1, 0.2
#: Added to linear base colours before the logarithm; differences of logarithms below the second are noise.
LOG_OFFSET, NOISE_FLOOR = 0.004, 0.03
#: Ridge weight of the coefficients, rounds of reweighting at most, damping of a step, and the change of a coefficient below which they end.
RIDGE, ROUNDS, DAMPING, CONVERGED = 1e-3, 25, 0.7, 1e-3
#: Factor on all scales and on the noise floor where they start wide, the share of the rounds in which it falls to 1, and by how much the
#: agreement must then be larger.
WIDENING, WIDENED_SHARE, MIN_AGREEMENT_GAIN = 20.0, 0.6, 0.01
#: Partial sums of the pairs: a fixed number, so that results do not depend on threads; and pairs that are summed at a time.
CHUNKS, BLOCK = 16, 64
#: Delighting: the irradiance is clamped to within this factor of its mean; lower bound of ambient occlusion, as indirect light fills
#: cavities and photos show them least reliably; this quantile of base colour is at most that of white paper.
MAX_IRRADIANCE_RATIO, MIN_OCCLUSION, ALBEDO_QUANTILE, MAX_ALBEDO = 3.0, 0.5, 0.995, 0.9
#: Points at which the irradiance of a changed light is matched, Gauss-Newton steps, their ridge weight and largest exponent.
MATCHED_POINTS, MATCHING_STEPS, MATCHING_RIDGE, MAX_EXPONENT = 4000, 4, 1e-3, 1.0

_1, _THIRD = np.float32(1), np.float32(1 / 3)
#: Where pairs differ so much that they count e⁻³⁰; smaller float32 numbers are denormal and slow.
_MAX_CHROMATICITY = np.float32(30)


@dataclass(frozen=True)
class RemainingShading(Rule):
    """Moves shading left in base colours to the light, `rounds` times and once more; between these texels adapt to it in the gradient
    `steps`.

    From there the light is given: gradient steps would move it back, as that base colours have no shading is not part of their loss.
    """

    steps: Steps
    rounds: int = 4

    def applies(self, scene: Scene, state: State) -> bool:
        """Where most is dielectric and the light stands: over all photos under a moving one there is hardly any."""
        return state.mostly_dielectric and not state.level.moving

    def run(self, scene: Scene, state: State) -> State:
        """The state under the light that is given from here on."""
        state = replace(state, light_given=True)
        for turn in range(self.rounds + 1):
            if turn:
                state = descend(scene, state, self.steps, scene.each("remaining shading"))
            seed = scene.seed + turn
            state = moved_to_light(state, shading_of(state, seed, widen=not turn), seed)
        return state


def shading_of(state: State, seed: int, widen: bool = True) -> Doubles:
    """Coefficients (8, 3) of the log shading that is left in the base colours of dielectrics; `widen`: it may be strong."""
    texel, surface = np.flatnonzero(state.dielectric), state.level.surface
    position = np.asarray(surface.position)[texel]
    generator = np.random.default_rng(seed)
    return remaining_shading(state.materials.base_color[texel], surface.unit_normals[texel], position, generator, widen)


@torch.no_grad()
def moved_to_light(state: State, shading: Doubles, seed: int) -> State:
    """The state with the shading of these coefficients (8, 3) moved from the base colours of dielectrics to the light."""
    texel = np.flatnonzero(state.dielectric)
    chosen = np.random.default_rng(seed).choice(texel, min(MATCHED_POINTS, len(texel)), replace=False)
    matched = state.level.surface.unit_normals[chosen]
    light = with_irradiance_factor(state.radiance, shading, matched, partial(irradiance, normals=matched))
    return state.under_light(EnvironmentLight.from_radiance(light), texel)


@dataclass(frozen=True)
class DelightingOptions:
    """Constants of delighting. Its solution has one white light, near pairs alone, and weights of chromaticity that do not change: photos'
    colours have stronger shading than what a fit leaves, which pairs anywhere would take for base colours."""

    #: Pairs are formed with this many nearest points, within this share of the bounding-box diagonal.
    neighbours: int = 24
    neighbour_radius: float = 0.04
    #: Scale of log-chromaticity differences above which two base colours are assumed.
    chromaticity_scale: float = 0.05
    #: Ridge weight on the squared coefficients, and rounds of reweighting.
    ridge: float = 1e-4
    rounds: int = 20


DELIGHTING = DelightingOptions()


@dataclass(frozen=True)
class Irradiance:
    """`coefficients` (8,) of the irradiance over its mean, in the order of `harmonics`."""

    coefficients: Doubles

    def at(self, normal: NDArray[np.floating]) -> Doubles:
        """Irradiance over its mean (n,) at unit normals (n, 3), clamped to `MAX_IRRADIANCE_RATIO`."""
        return np.clip(1 + harmonics(normal) @ self.coefficients, 1 / MAX_IRRADIANCE_RATIO, MAX_IRRADIANCE_RATIO)

    def light(self, size: int, intensity: float) -> EnvironmentLight:
        """A white environment, cube map of edge `size`, with this irradiance (over π) times `intensity`; negative radiance is clamped."""
        order = np.array([1.5] * 3 + [4.0] * 5)  # π over the cosine lobe's own coefficients 2π/3 and π/4

        def radiance(directions: Doubles) -> Doubles:
            value = intensity * np.maximum(1 + harmonics(directions) @ (order * self.coefficients), 0)
            return np.repeat(value[:, None], 3, 1)

        return EnvironmentLight.from_function(radiance, size)


def find_irradiance(
    colour: NDArray[np.floating], normal: NDArray[np.floating], position: NDArray[np.floating], occlusion: NDArray[np.floating]
) -> Irradiance:
    """The irradiance that best explains the differences between n points of the surface; uniform without usable pairs.

    `colour` (n, 3) linear, `normal` (n, 3) unit, `position` (n, 3), `occlusion` (n,) ambient occlusion, 1 = open.
    """
    o = DELIGHTING
    a, b = nearby_pairs(np.asarray(position, np.float64), o.neighbours, o.neighbour_radius)
    logs = np.log(np.maximum(colour, 0).astype(np.float64) + LOG_OFFSET)
    brightness = logs.mean(1)
    chroma = logs - brightness[:, None]
    weight = np.exp(-((np.linalg.norm(chroma[a] - chroma[b], axis=1) / o.chromaticity_scale) ** 2))
    unoccluded = brightness - np.log(np.maximum(occlusion, MIN_OCCLUSION))
    difference = unoccluded[a] - unoccluded[b]
    basis = harmonics(normal)
    found = np.zeros(8)
    if not weight.sum() > 0:
        return Irradiance(found)
    ridge = o.ridge * weight.sum()
    for _ in range(o.rounds):
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


class _Pairs(NamedTuple):
    """m pairs of the `points` (n, 11), eight harmonics and three log base colours each: their indices `first` and `second` (m,), the
    `share` (m,) that each weighs, and the `scale` (m,) of its brightness difference."""

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    points: NDArray[np.float32]
    share: NDArray[np.float32]
    scale: NDArray[np.float32]

    @classmethod
    def of(cls, points: NDArray[np.float32], position: Doubles, generator: np.random.Generator) -> _Pairs:
        """Pairs of points at `position` (n, 3); nearby ones weigh as much together as those anywhere."""
        count = len(position)
        far = np.repeat(np.arange(count), PARTNERS), generator.integers(0, count, count * PARTNERS)
        near = nearby_pairs(position, NEIGHBOURS, NEIGHBOUR_RADIUS)
        sizes = (len(far[0]), len(near[0]))
        share = np.repeat([1 / max(1, n) for n in sizes], sizes)
        scale = np.repeat([BRIGHTNESS_SCALE, NEARBY_BRIGHTNESS_SCALE], sizes)
        first, second = (np.concatenate([f, n]).astype(np.int32) for f, n in zip(far, near, strict=True))
        return cls(first, second, points, share.astype(np.float32), scale.astype(np.float32))


def remaining_shading(
    base_color: NDArray[np.floating],
    normal: NDArray[np.floating],
    position: NDArray[np.floating],
    generator: np.random.Generator,
    widen: bool = True,
) -> Doubles:
    """Coefficients e (8, 3) of the log shading that is left in the linear base colours (n, 3) of points with unit normals (n, 3) and
    positions (n, 3); zeros where there are fewer than two points. Without `widen` scales do not start wide."""
    if len(base_color) < 2:
        return np.zeros((8, 3))
    chosen = generator.choice(len(base_color), min(POINTS, len(base_color)), replace=False)
    logs = np.log(np.maximum(np.asarray(base_color[chosen], np.float64), 0) + LOG_OFFSET)
    points = np.column_stack([harmonics(normal[chosen]), logs]).astype(np.float32)
    pairs = _Pairs.of(points, np.asarray(position[chosen], np.float64), generator)
    plain, agreement = _solve(pairs, 1.0)
    if not widen:
        return plain
    widened, widened_agreement = _solve(pairs, WIDENING)
    return widened if widened_agreement > (1 + MIN_AGREEMENT_GAIN) * agreement else plain


def _solve(pairs: _Pairs, widening: float) -> tuple[Doubles, float]:
    """The coefficients (8, 3) found from none, with all scales multiplied by a factor that falls from `widening` to 1, and the agreement of
    the pairs with them."""
    found = np.zeros((8, 3))
    matrices, rights, weights = (np.zeros((CHUNKS, 3, *shape)) for shape in ((8, 8), (8,), ()))
    agreement = np.zeros(CHUNKS)
    sums = matrices, rights, weights, agreement
    for turn in range(ROUNDS):
        wider = max(1.0, widening ** (1 - turn / (WIDENED_SHARE * ROUNDS)))
        normal_equations(*pairs, found.astype(np.float32), wider, *sums)
        before = found.copy()
        for channel in range(3):
            ridge = RIDGE * max(float(weights[:, channel].sum()), 1e-12)
            step = rights[:, channel].sum(0) - ridge * found[:, channel]
            found[:, channel] += DAMPING * np.linalg.solve(matrices[:, channel].sum(0) + ridge * np.eye(8), step)
        if wider == 1 and np.abs(found - before).max() < CONVERGED:
            break
    normal_equations(*pairs, found.astype(np.float32), 1.0, *sums)
    return found, float(agreement.sum())


@kernel(
    "i4[::1], i4[::1], f4[:, ::1], f4[::1], f4[::1], f4[:, ::1], f8, f8[:, :, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[::1]",
    parallel=True,
    nogil=True,
)
def normal_equations(
    first: Any, second: Any, points: Any, share: Any, scale: Any, found: Any, wider: Any, matrices: Any, rights: Any, weights: Any,
    agreement: Any,
) -> None:  # fmt: skip
    """Matrix, right side and sum of weights of one round's least squares for each channel, in a fixed number of partial sums.

    The pairs (`first`, `second`) (m,) of `points` (n, 11), eight harmonics and three log base colours each, count as `share` (m,), less
    where brightness differs by `scale` (m,) after the shading of the coefficients `found` (8, 3); all scales are multiplied by `wider`.
    `matrices` (CHUNKS, 3, 8, 8), `rights` (CHUNKS, 3, 8), `weights` (CHUNKS, 3) and `agreement` (CHUNKS,), the sum of what pairs count, are
    overwritten.
    """
    size = -(-len(first) // CHUNKS)
    for chunk in prange(CHUNKS):
        start, end = chunk * size, min(len(first), (chunk + 1) * size)
        sums = matrices[chunk], rights[chunk], weights[chunk]
        agreement[chunk] = _sum_pairs(start, end, first, second, points, share, scale, found, wider, *sums)


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_pairs(
    start: Any, end: Any, first: Any, second: Any, points: Any, share: Any, scale: Any, found: Any, wider: Any, matrix: Any, right: Any,
    total: Any,
) -> Any:  # fmt: skip
    """The same for the pairs from `start` to `end`; what they count together.

    Pairs are float32 and go through in blocks; sums have an element for each place in a block, so that loops over these are vector
    instructions without a change of the order of sums. A function of its own, as Numba analyses parallel loops longer.
    """
    floor, per_scale = np.float32(wider * NOISE_FLOOR), np.float32(1 / wider)
    per_chromaticity = np.float32(1 / (wider * CHROMATICITY_SCALE) ** 2)
    slope, similar = np.zeros((11, BLOCK), np.float32), np.zeros(BLOCK, np.float32)
    weight, weighted = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    rest = slope[8:]
    products, rights = np.zeros((3, 36, BLOCK), np.float32), np.zeros((3, 8, BLOCK), np.float32)
    weights = np.zeros((3, BLOCK), np.float32)
    counted = 0.0
    for block in range(start, end, BLOCK):
        n = min(BLOCK, end - block)
        similar[n:] = 0
        for p in range(n):
            i, j = np.uint64(first[block + p]), np.uint64(second[block + p])
            for k in range(11):
                slope[k, p] = points[i, k] - points[j, k]
        for c in range(3):
            for k in range(8):
                for p in range(BLOCK):
                    rest[c, p] -= slope[k, p] * found[k, c]
        for p in range(n):
            brightness = (rest[0, p] + rest[1, p] + rest[2, p]) * _THIRD
            red, green, blue = rest[0, p] - brightness, rest[1, p] - brightness, rest[2, p] - brightness
            chromaticity = min((red * red + green * green + blue * blue) * per_chromaticity, _MAX_CHROMATICITY)
            brightness *= per_scale / scale[block + p]
            similar[p] = share[block + p] * math.exp(-chromaticity) / (_1 + brightness * brightness)
            counted += similar[p]
        for c in range(3):
            for p in range(BLOCK):
                weight[p] = similar[p] / max(abs(rest[c, p]), floor)
                weights[c, p] += weight[p]
            entry = 0
            for k in range(8):
                for p in range(BLOCK):
                    weighted[p] = weight[p] * slope[k, p]
                    rights[c, k, p] += weighted[p] * rest[c, p]
                for m in range(k + 1):
                    for p in range(BLOCK):
                        products[c, entry, p] += weighted[p] * slope[m, p]
                    entry += 1
    for c in range(3):
        total[c] = weights[c].sum()
        entry = 0
        for k in range(8):
            right[c, k] = rights[c, k].sum()
            for m in range(k + 1):
                matrix[c, k, m] = matrix[c, m, k] = products[c, entry].sum()
                entry += 1
    return counted


def with_irradiance_factor(
    radiance: NDArray[np.floating],
    coefficients: Doubles,
    normal: NDArray[np.floating],
    irradiance: Callable[[NDArray[np.float32]], NDArray[np.floating]],
) -> NDArray[np.float32]:
    """The environment `radiance` (6, s, s, 3) changed smoothly so that its irradiance is multiplied by exp(Σ_k e_k Y_k(n)), with the mean
    over the unit normals (n, 3) kept.

    `irradiance` gives the irradiance (n, 3) at the normals under an environment. The radiance is multiplied by exp(Σ_k q_k Y_k(d)) of
    orders 0 to 2, whose q are found by Gauss-Newton steps on the relative error of the irradiance.
    """
    shape = radiance.shape
    target = np.exp(harmonics(normal) @ coefficients)
    target = np.asarray(irradiance(np.asarray(radiance, np.float32)), np.float64) * target / target.mean(0)
    light = np.asarray(radiance, np.float64).reshape(-1, 3)
    around = directions(shape[1]).reshape(-1, 3)
    basis = np.column_stack([np.ones(len(around)), harmonics(around)])
    ridge = MATCHING_RIDGE * len(normal) * np.diag([0.0] + [1.0] * 8)

    def lit(light: Doubles) -> Doubles:
        return np.asarray(irradiance(light.reshape(shape).astype(np.float32)), np.float64) / np.maximum(target, 1e-12)

    for _ in range(MATCHING_STEPS):
        error = 1 - lit(light)
        slopes = np.stack([lit(light * basis[:, k : k + 1]) for k in range(basis.shape[1])], 2)  # (n, 3, 9)
        for channel in range(3):
            slope = slopes[:, channel]
            q = np.linalg.solve(slope.T @ slope + ridge, slope.T @ error[:, channel])
            light[:, channel] *= np.exp(np.clip(basis @ q, -MAX_EXPONENT, MAX_EXPONENT))
    return light.reshape(shape).astype(np.float32)


def harmonics(direction: NDArray[np.floating]) -> Doubles:
    """Spherical harmonics (n, 8) of orders 1 and 2 at unit directions (n, 3), not normalised: x, y, z, xy, yz, zx, x²−y², 3z²−1."""
    x, y, z = np.asarray(direction, np.float64).T
    return np.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)


def nearby_pairs(position: Doubles, neighbours: int, radius_share: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
