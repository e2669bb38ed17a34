"""Detection of emissive regions: parts of the texture whose radiance does not follow their irradiance.

Under one light, emission and bright albedo look the same at a single texel. Over a region of one colour they do not: reflected radiance
follows the irradiance E as orientation and shadows vary, emitted radiance is constant. Per texel, photos give the diffuse radiance (the
specular part subtracted), the fit gives E; in every connected region of similar texels log radiance is regressed on log E:

    reflection: slope 1        emission: slope 0, and radiance hardly varies while E does.

Such a region must end at an edge: an emissive part is a part, whereas an iso-brightness band on a shaded surface is not.

E is first replaced by its linear fit over the region: noise of the mesh's normals would flatten the slope of any reflection. Regions are
tested only where radiance / E is near or above 1: energy is conserved, and albedos end at .8 (Lagarde & de Rousiers, *Moving Frostbite to
PBR*, 2014). A flat emitter under uniform light cannot be distinguished and stays a reflector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from gsbake.materials.linear_shading import PhotoSamples, observed_weight, perceptual_weights
from gsbake.materials.metallic import MIN_WEIGHT

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class EmissionOptions:
    """Constants of the detection of emissive regions."""

    #: Neighbours join a region when they differ by less than this share of their strongest channel, and are brighter than this (linear).
    max_difference: float = 0.08
    min_radiance: float = 0.08
    #: Smallest region tested, in texels.
    min_region: int = 64
    #: Median radiance / E (strongest channel) from which a region is tested.
    min_albedo: float = 0.7
    #: Standard deviations of logarithms: of the irradiance at least; of the radiance at most, as a share of that. Largest slope.
    min_irradiance_deviation: float = 0.025
    max_deviation_ratio: float = 0.5
    max_slope: float = 0.25
    #: Texels of a region beyond this many robust standard deviations are outliers (prints, boundaries).
    outlier_deviations: float = 3.0
    #: Beyond the boundary, within as many steps, the median texel must differ from the region by this share of its strongest channel.
    min_edge_contrast: float = 0.3


OPTIONS = EmissionOptions()

#: A region's boundary mixes with its surroundings: texels within this many steps with the same hue (cosine) are emissive too.
BOUNDARY_STEPS, MIN_HUE_COSINE = 2, 0.97


@dataclass(frozen=True)
class Emission:
    """Emissive texels (m,), their linear `radiance` (m, 3), and the number of `regions`."""

    texel: NDArray[np.int64]
    radiance: Floats
    regions: int


def find_emission(
    photos: Sequence[PhotoSamples], roughness: NDArray[np.float32], pairs: NDArray[np.int64], position: NDArray[np.floating]
) -> Emission:
    """The emissive texels, from the texels' present `roughness` (n,), neighbouring `pairs` (p, 2) and `position` (n, 3)."""
    n = len(roughness)
    radiance, irradiance = _diffuse_radiance(photos, roughness)
    peak = radiance.max(1)
    pairs = pairs[(observed_weight(photos, n) > MIN_WEIGHT)[pairs].all(1)]
    first, second = pairs[(peak > OPTIONS.min_radiance)[pairs].all(1)].T
    difference = np.abs(radiance[first] - radiance[second]).max(1)
    similar = difference < OPTIONS.max_difference * np.maximum(peak[first], peak[second])
    region = _components(n, first[similar], second[similar])
    emissive_regions: list[NDArray[np.int64]] = []
    sizes = np.bincount(region)
    order = np.argsort(region, kind="stable")
    ends = np.cumsum(sizes)
    for index in np.flatnonzero(sizes >= OPTIONS.min_region):
        member = order[ends[index] - sizes[index] : ends[index]]
        inlier = member[_inliers(radiance[member].mean(1))]
        if _is_emissive(radiance[inlier], irradiance[inlier], position[inlier]) and _ends_at_edge(member, radiance, pairs):
            emissive_regions.append(member)
    emissive = np.zeros(n, bool)
    for member in emissive_regions:
        emissive[_with_boundary(member, np.median(radiance[member], 0), radiance, pairs)] = True
    texel = np.flatnonzero(emissive)
    return Emission(texel, np.maximum(radiance[texel], 0), len(emissive_regions))


def _diffuse_radiance(photos: Sequence[PhotoSamples], roughness: NDArray[np.float32]) -> tuple[Floats, Floats]:
    """Per texel, averaged over the photos: radiance (n, 3) without the specular part, and irradiance / π (n, 3)."""
    n = len(roughness)
    radiance, irradiance, total = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    for photo in photos:
        weight, shading = perceptual_weights(photo), photo.shade(roughness).dielectric
        for sums, value in ((radiance, weight * (photo.colour - shading.offset)), (irradiance, weight * shading.slope), (total, weight)):
            for k in range(3):
                sums[:, k] += np.bincount(photo.texel, value[:, k], n)
    count = np.maximum(total, 1e-12)
    return radiance / count, irradiance / count


def _components(n: int, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    """Connected component (n,) of each of n texels, joined by the pairs (`first`, `second`)."""
    graph = scipy.sparse.coo_matrix((np.ones(len(first), bool), (first, second)), shape=(n, n))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], np.int64)


def _inliers(brightness: Floats) -> NDArray[np.bool_]:
    """Which texels (m,) of a region are not outliers in `brightness` (m,)."""
    median = np.median(brightness)
    deviation = np.abs(brightness - median)
    return np.asarray(deviation <= OPTIONS.outlier_deviations * 1.4826 * np.median(deviation) + 0.01 * median)


def _is_emissive(radiance: Floats, irradiance: Floats, position: NDArray[np.floating]) -> bool:
    """Whether a region of m texels emits: diffuse `radiance` (m, 3), `irradiance` / π (m, 3), `position` (m, 3)."""
    albedo = np.median(radiance / np.maximum(irradiance, 1e-6), 0).max()
    if not albedo > OPTIONS.min_albedo:
        return False
    linear = np.column_stack([np.ones(len(position)), position - position.mean(0)])
    mean_irradiance = irradiance.mean(1)
    smooth = linear @ np.linalg.lstsq(linear, mean_irradiance, rcond=None)[0]
    x, y = np.log(np.maximum(smooth, 1e-6)), np.log(np.maximum(radiance.mean(1), 1e-6))
    x, y = x - x.mean(), y - y.mean()
    return bool(
        x.std() > OPTIONS.min_irradiance_deviation
        and y.std() < OPTIONS.max_deviation_ratio * x.std()
        and (x @ y) < OPTIONS.max_slope * (x @ x)
    )


def _ends_at_edge(member: NDArray[np.int64], radiance: Floats, pairs: NDArray[np.int64]) -> bool:
    """Whether the region `member` (m,) ends at an edge of `radiance` (n, 3) rather than in a gradient."""
    median = np.median(radiance[member], 0)
    inside = _dilate(member, len(radiance), pairs, BOUNDARY_STEPS)
    ring = _dilate(np.flatnonzero(inside), len(radiance), pairs, BOUNDARY_STEPS) & ~inside
    return bool(ring.any()) and bool(np.median(np.abs(radiance[ring] - median).max(1)) > OPTIONS.min_edge_contrast * median.max())


def _dilate(
    member: NDArray[np.int64], n: int, pairs: NDArray[np.int64], steps: int, allowed: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Mask (n,) of the texels within `steps` of `member` (m,), through `allowed` (n,) texels only."""
    inside = np.zeros(n, bool)
    inside[member] = True
    for _ in range(steps):
        adjacent = pairs[inside[pairs].any(1)].ravel()
        inside[adjacent if allowed is None else adjacent[allowed[adjacent]]] = True
    return inside


def _with_boundary(member: NDArray[np.int64], hue: Floats, radiance: Floats, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """`member` and the texels of its `hue` (3,) within `BOUNDARY_STEPS`."""
    length = np.maximum(np.linalg.norm(radiance, axis=1), 1e-12)
    same = (radiance @ hue) / (length * np.linalg.norm(hue)) > MIN_HUE_COSINE
    return np.flatnonzero(_dilate(member, len(radiance), pairs, BOUNDARY_STEPS, same))
