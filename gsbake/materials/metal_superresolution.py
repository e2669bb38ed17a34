"""Super-resolution of base colour on perforated metal: a linear inverse problem at the full texture, finer than the photos' pixels.

Grilles, meshes and engravings have patterns of a pixel or two, bright metal beside black holes. A fit with texels of a pixel's width mixes
both into grey. Shading is linear in base colour, though, so with light and roughness known each pixel says

    colour − offset = slope · mean of b over the texels that the pixel covers,

and the pixels of all photos together determine more than one value per pixel. The weighted squares (perceptual, robust) are reduced by
simultaneous iterations (SIRT), within [0, 1] and near the initial values where no pixel constrains them.

Holes are at the same places in all photos, unexplained reflections are not. So the problem is solved with each half of the photos; where
their mean has dark texels beside bright ones and both show the same pattern, the metal is perforated. The halves start without detail:
what pixels do not determine would stay in both, and agree. They are compared where both have pixels. Other metal keeps its fitted values,
which have less noise. So do dielectrics: their photos depend on diffuse shading, which the fit at pixel size determines as well, and
residual reflections would become stains.

Perforated metal is solved once more with a binary prior: one metal, and holes. From step to step every texel is drawn, finally as strongly
as by the pixels, to metal or to black: the brightest texels to metal, as many as the local mean brightness implies (a threshold at half the
metal's brightness would select too many, as blurred thin bars brighten the edges of holes). Meanwhile two constraints are relaxed, as bars
are curved and the fitted light is blurred: brightness may exceed 1, and shading may be off by a gain that varies slowly over a photo and is
estimated in each step (`_PhotoSystem.local_gain`). A pixel then constrains brightness relative to its neighbourhood.

Goldlücke & Cremers, *Superresolution texture maps for multiview reconstruction*, ICCV 2009 (a texture finer than the photos, each pixel the
mean of what it covers); Gilbert, *Iterative methods for the three-dimensional reconstruction of an object from projections*, 1972 (SIRT).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.materials.linear_shading import LinearShading, PhotoSamples, unclipped_weights
from gsbake.materials.metallic import MIN_METAL_ALBEDO
from gsbake.materials.passes import Rule, Scene
from gsbake.materials.photo import PhotoReader
from gsbake.materials.state import State
from gsbake.materials.surface import Materials
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class SuperresolutionOptions:
    """Constants of the super-resolution; lengths are in texels unless said otherwise."""

    #: Iterations of the solver.
    solver_steps: int = 15
    #: Weight of the initial values, as a share of the median weight of the pixels.
    initial_weight: float = 0.001
    #: A photo's gain is averaged over about this many pixels, lies within this factor of 1, and tends to 1 where expected colours are below
    #: this share of their mean.
    gain_radius: float = 4.0
    max_gain: float = 8.0
    gain_regularisation: float = 0.003
    #: A texel lies in a metal region where this share of texels around it, within about so many texels, is metal: holes belong to the
    #: region.
    region_radius: float = 2.0
    min_metal_share: float = 0.35
    #: Metal is perforated where the share of texels darker than this share of the metal's brightness is between these bounds: others were
    #: fitted as well and have less noise. Photos blur holes of a pixel or two, so these are not black before the binary prior acts.
    dark: float = 0.5
    hole_share: tuple[float, float] = (0.1, 0.7)
    #: Radius in texels of local statistics, and of the smoothing below which detail begins.
    local_radius: float = 12.0
    detail_radius: float = 3.0
    #: Least correlation of the detail in the two halves of the photos.
    min_correlation: float = 0.25
    #: Steps before the binary prior starts, the largest brightness while it acts, and the power of relative brightness that weighs texels
    #: in the metal's colour (photos blur bars as well).
    unconstrained_steps: int = 3
    max_brightness: float = 1.5
    brightness_power: int = 4
    #: Thresholds between hole and bar that are interpolated, and the final one; shares of the metal's brightness.
    bar_thresholds: tuple[float, ...] = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
    hole_threshold: float = 0.25
    #: Reflectance of dielectrics at normal incidence.
    dielectric_f0: float = 0.04


OPTIONS = SuperresolutionOptions()

#: Hue is averaged over about this many texels: patterns differ in brightness, while a misplaced reflection has a hue.
HUE_RADIUS = 4.0
#: sRGB errors beyond this count linearly.
ROBUST_SCALE = 0.1


@dataclass(frozen=True)
class MetalPixels:
    """m pixels of one photo: their `column` (m,) and `row` (m,), the texels (m, k) each averages and which of them `counts` (m, k), their
    `samples`, and their `shading` in a metal's base colour."""

    column: NDArray[np.int64]
    row: NDArray[np.int64]
    texel: NDArray[np.int64]
    counts: NDArray[np.bool_]
    samples: PhotoSamples
    shading: LinearShading


@dataclass(frozen=True)
class MetalSuperresolution(Rule):
    """Solves the base colour of perforated metal at the texels of the asset."""

    def applies(self, scene: Scene, state: State) -> bool:
        """Where there is metal, and a map of it."""
        return state.maps is not None and bool(state.metal.any() and state.maps.metallic.any())

    def run(self, scene: Scene, state: State) -> State:
        """The maps with perforated metal solved."""
        assert scene.target is not None and state.maps is not None
        target, mesh, roughness = scene.target, scene.target.mesh, (state.selected or state.materials).roughness
        region = metal_regions(target.texture.texels, state.metal)
        reader = PhotoReader(mesh.atlas_caster, mesh.atlas.uv, mesh.texels, mesh.texel_normal, mesh.diagonal)
        metal_pixels = []
        for photo in state.level.photos:
            camera, shown = target.cameras[photo.index], photo.showing(region)
            for samples in state.samples([shown]):  # none where nothing is shown
                row, column = np.divmod(shown.pixel, camera.width)
                shading = samples.shade(roughness).metal
                metal_pixels.append(MetalPixels(column, row, *reader.subpixel_texels(camera, shown.pixel), samples, shading))
        covered = target.texture.up(region[:, None].astype(np.float32))[:, 0] > 0.5
        return replace(state, maps=superresolved(state.maps, mesh.texels, covered, metal_pixels))


def metal_regions(texels: Texels, metal: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (n,) of the texels in a neighbourhood of mostly `metal` (n,)."""
    image = texels.image(metal[:, None].astype(np.float32))
    share = cv2.GaussianBlur(image, (0, 0), OPTIONS.region_radius).ravel()[texels.index]
    return np.asarray(share > OPTIONS.min_metal_share)


def superresolved(maps: Materials, texels: Texels, region: NDArray[np.bool_], photos: Sequence[MetalPixels]) -> Materials:
    """`maps` of `texels` with perforated metal in `region` (n,) solved.

    Results darker than any metal, or much darker than the metal around, are holes: dielectric and rough, without a specular reflection of
    the room. The rest of the perforated metal has metallic 1.
    """

    def prior(base: Floats) -> Floats:
        return _metal_or_black(base, texels, perforated)

    if not region.any():
        return maps
    even = _local_mean(maps.base_color[region], texels, region, OPTIONS.detail_radius)
    systems = _photo_systems(photos, region)
    parts = [systems[first::2] for first in range(2)]
    halves = [_with_local_hue(_solve(part, even), texels, region) for part in parts]
    both = np.asarray((halves[0] + halves[1]) / 2, np.float32)
    dark = both.mean(1) < np.maximum(OPTIONS.dark * _metal_colour(both, texels, region).mean(1), MIN_METAL_ALBEDO)
    perforated = region.copy()
    shown = np.logical_and(*(_shown(part, len(even)) for part in parts))
    perforated[region] = _has_holes(texels, region, dark) & _correlated(texels, region, shown, *(half.mean(1) for half in halves))
    if not perforated.any():
        return maps
    base = _with_local_hue(_solve(_photo_systems(photos, perforated), maps.base_color[perforated], prior), texels, perforated)
    metal = _metal_colour(base, texels, perforated).mean(1)
    hole = base.mean(1) < np.maximum(OPTIONS.hole_threshold * metal, MIN_METAL_ALBEDO)
    out = maps.copied()
    out.base_color[perforated] = np.where(hole[:, None], np.maximum(base - OPTIONS.dielectric_f0, 0), np.minimum(base, 1))
    if np.ptp(maps.roughness) > 0:  # a constant roughness stays constant
        out.roughness[perforated] = np.where(hole, 1, out.roughness[perforated])
    out.metallic[perforated] = ~hole
    return out


def _has_holes(texels: Texels, region: NDArray[np.bool_], hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the t texels in `region` (n,) have both metal and holes (t,) around them."""
    share = _local_mean(hole[:, None].astype(np.float32), texels, region, OPTIONS.local_radius)[:, 0]
    return np.asarray((share > OPTIONS.hole_share[0]) & (share < OPTIONS.hole_share[1]))


def _correlated(texels: Texels, region: NDArray[np.bool_], shown: NDArray[np.bool_], first: Floats, second: Floats) -> NDArray[np.bool_]:
    """Where (t,) in `region` (n,) the detail of two brightnesses (t,) is locally correlated, over texels that are `shown` (t,) in both."""
    both = np.stack([first, second], 1)
    a, b = (both - _local_mean(both, texels, region, OPTIONS.detail_radius)).T
    products = _local_mean(np.stack([a * b, a * a, b * b], 1), texels, region, OPTIONS.local_radius, shown.astype(np.float32))
    covariance, variance_a, variance_b = products.T
    return np.asarray(covariance > OPTIONS.min_correlation * np.sqrt(variance_a * variance_b))


def _local_mean(
    values: NDArray[np.floating], texels: Texels, region: NDArray[np.bool_], radius: float, weight: NDArray[np.floating] | None = None
) -> Floats:
    """Gaussian mean over about `radius` texels of `values` (t, c) in `region` (n,), weighted by `weight` (t,)."""
    w = np.ones(len(values), np.float32) if weight is None else weight
    row, column = np.divmod(texels.index[region], texels.size)
    row, column = row - row.min(), column - column.min()
    image = np.zeros((row.max() + 1, column.max() + 1, values.shape[1] + 1), np.float32)
    image[row, column, :-1], image[row, column, -1] = values * w[:, None], w
    blurred = cv2.GaussianBlur(image, (0, 0), radius)[row, column]
    return np.asarray(blurred[:, :-1] / np.maximum(blurred[:, -1:], 1e-6))


def _with_local_hue(base: Floats, texels: Texels, region: NDArray[np.bool_]) -> Floats:
    """`base` (t, 3) in `region` (n,) with its own brightness and the mean hue around."""
    around = _local_mean(base, texels, region, HUE_RADIUS)
    return np.asarray(around * (base.mean(1) / np.maximum(around.mean(1), 1e-6))[:, None])


def _metal_colour(base: Floats, texels: Texels, region: NDArray[np.bool_]) -> Floats:
    """Colour (t, 3) of the metal around each texel of `base` (t, 3) in `region` (n,): the mean of the brighter ones."""
    brightness = base.mean(1)
    ratio = brightness / np.maximum(_local_mean(base, texels, region, OPTIONS.local_radius).mean(1), 1e-6)
    return _local_mean(base, texels, region, OPTIONS.local_radius, (ratio > 1) * ratio**OPTIONS.brightness_power)


def _metal_or_black(base: Floats, texels: Texels, region: NDArray[np.bool_]) -> Floats:
    """For each texel of `base` (t, 3) in `region` (n,) the colour (t, 3) of the metal around it, or black.

    The brightest texels are metal. The threshold, a share of the metal's brightness, is interpolated between `bar_thresholds` such that the
    local mean of the binary image is that of `base`.
    """
    metal = _metal_colour(base, texels, region)
    share = base.mean(1) / np.maximum(metal.mean(1), 1e-6)
    above = _local_mean(
        np.column_stack([share[:, None] > np.asarray(OPTIONS.bar_thresholds), share]), texels, region, OPTIONS.detail_radius
    )
    wanted = above[:, -1]
    threshold = np.full(len(base), OPTIONS.bar_thresholds[0])
    for k in range(1, len(OPTIONS.bar_thresholds)):
        more, fewer = above[:, k - 1], above[:, k]
        part = np.clip((more - wanted) / np.maximum(more - fewer, 1e-6), 0, 1)
        interpolated = OPTIONS.bar_thresholds[k - 1] + part * (OPTIONS.bar_thresholds[k] - OPTIONS.bar_thresholds[k - 1])
        threshold = np.where(more > wanted, interpolated, threshold)
    return np.where((share > threshold)[:, None], metal, np.float32(0))


@dataclass(frozen=True)
class _PhotoSystem:
    """One photo's part of the linear system: the matrix `mean` (m, t) that averages t texels for its m pixels, their `column` and `row`
    (m,), linear `colour` (m, 3), `weight` (m, 3) and `shading`."""

    mean: Any
    column: NDArray[np.int64]
    row: NDArray[np.int64]
    colour: Floats
    weight: Floats
    shading: LinearShading

    def local_gain(self, base: Floats, previous: Floats) -> Floats:
        """Ratio (m, 1) of photo to shading around each pixel of base colour `base` (m, 3); `previous` (m, 1) is the last estimate."""
        weight = self._robust_weights(base, self._gained(previous))
        shaded = self.shading.slope * base + self.shading.offset
        sums = np.stack([(weight * shaded * self.colour).sum(1), (weight * shaded**2).sum(1)], 1)
        column, row = self.column - self.column.min(), self.row - self.row.min()
        image = np.zeros((row.max() + 1, column.max() + 1, 2), np.float32)
        image[row, column] = sums
        observed, expected = cv2.GaussianBlur(image, (0, 0), OPTIONS.gain_radius)[row, column].T
        prior = OPTIONS.gain_regularisation * expected.mean()
        ratio = (observed + prior) / np.maximum(expected + prior, 1e-12)
        return np.asarray(np.clip(ratio, 1 / OPTIONS.max_gain, OPTIONS.max_gain)[:, None], np.float32)

    def normal_equations(self, base: Floats, gain: Floats) -> tuple[Floats, Floats]:
        """Gradient (t, 3) and weight (t, 3) for the texels where pixels have base colour `base` (m, 3) and `gain` (m, 1)."""
        shading = self._gained(gain)
        weight = self._robust_weights(base, shading)
        rest = self.colour - shading.offset - shading.slope * base
        return self.mean.T @ (weight * shading.slope * rest), self.mean.T @ (weight * shading.slope**2)

    def _gained(self, gain: Floats) -> LinearShading:
        """The shading times `gain` (m, 1)."""
        return LinearShading(gain * self.shading.slope, gain * self.shading.offset)

    def _robust_weights(self, base: Floats, shading: LinearShading) -> Floats:
        """The weights (m, 3), reduced for pixels with large errors of `shading` at `base` (m, 3)."""
        error = np.abs(shading.srgb(base) - encode(self.colour))
        return np.asarray(self.weight / np.maximum(error / ROBUST_SCALE, 1), np.float32)


def _photo_systems(photos: Sequence[MetalPixels], region: NDArray[np.bool_]) -> list[_PhotoSystem]:
    """The linear systems of the texels in `region` (n,), from pixels most of which lies there."""
    index = np.cumsum(region) - 1
    systems: list[_PhotoSystem] = []
    for photo in photos:
        counts = photo.counts & region[photo.texel]
        used = 2 * counts.sum(1) > counts.shape[1]
        if not used.any():
            continue
        row, k = np.nonzero(counts[used])
        share = (1 / counts.sum(1)[used][row]).astype(np.float32)
        mean = scipy.sparse.csr_matrix((share, (row, index[photo.texel[used][row, k]])), shape=(int(used.sum()), int(region.sum())))
        shading = LinearShading(photo.shading.slope[used], photo.shading.offset[used])
        weight = unclipped_weights(photo.samples)[used]
        systems.append(_PhotoSystem(mean, photo.column[used], photo.row[used], photo.samples.colour[used], weight, shading))
    return systems


def _shown(systems: Sequence[_PhotoSystem], texels: int) -> NDArray[np.bool_]:
    """Which of the `texels` texels pixels of some photo show."""
    shown = np.zeros(texels, bool)
    for system in systems:
        shown[system.mean.indices] = True
    return shown


def _solve(systems: Sequence[_PhotoSystem], initial: Floats, prior: Callable[[Floats], Floats] | None = None) -> Floats:
    """Base colours (t, 3) in [0, 1] that reproduce the photos, near `initial` (t, 3).

    With `prior` they are drawn increasingly to its value for the present ones, up to `max_brightness`, and photos have local gains.
    """
    base = initial.copy()
    gains = [np.ones((len(system.row), 1), np.float32) for system in systems]
    for step in range(OPTIONS.solver_steps):
        gradient, weight = np.zeros_like(initial), np.zeros_like(initial)
        for k, system in enumerate(systems):
            pixel_base = np.asarray(system.mean @ base)
            if prior is not None:
                gains[k] = system.local_gain(pixel_base, gains[k])
            photo_gradient, photo_weight = system.normal_equations(pixel_base, gains[k])
            gradient += photo_gradient
            weight += photo_weight
        median = np.median(weight[weight > 0]) if (weight > 0).any() else 1.0
        gradient, weight = gradient + OPTIONS.initial_weight * median * (initial - base), weight + OPTIONS.initial_weight * median
        if prior is not None and step >= OPTIONS.unconstrained_steps:
            strength = median * (step + 1 - OPTIONS.unconstrained_steps) / (OPTIONS.solver_steps - OPTIONS.unconstrained_steps)
            gradient, weight = gradient + strength * (prior(base) - base), weight + strength
        base = np.asarray(np.clip(base + gradient / weight, 0, 1 if prior is None else OPTIONS.max_brightness), np.float32)
    return base
