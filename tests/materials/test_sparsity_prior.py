"""The sparsity prior: mean shift of materials, and its effect on fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode, encode
from gsbake.materials.passes import Priors
from gsbake.materials.sparsity_prior import KERNEL_WIDTHS, METAL_THRESHOLD, common_materials, mean_shift
from gsbake.materials.surface import Materials
from tests.materials.test_fit import WEAK_PRIORS, Sphere, after, observed

WIDTHS = (0.03, 0.05)


def cloud(seed: int = 0) -> NDArray[np.float64]:
    """Two tight clusters and a few hundred uniformly distributed points."""
    random = np.random.default_rng(seed)
    clusters = [random.normal(at, 0.02, (2000, 2)) for at in ((0.3, 0.5), (0.7, 0.4))]
    return np.concatenate([*clusters, random.uniform(0, 1, (400, 2))])


def test_means_are_weighted_by_a_gaussian() -> None:
    points = cloud()
    chosen = np.random.default_rng(1).choice(len(points), 60, replace=False)
    # Linear splatting and slicing each add the variance of a hat function, a sixth of the squared cell.
    wide = np.asarray(WIDTHS) * np.sqrt(1 + 2 / 6)
    weight = np.exp(-0.5 * (((points[chosen, None] - points[None]) / wide) ** 2).sum(2))
    truth = weight @ points / weight.sum(1, keepdims=True)
    # A grid of one deviation reads a Gaussian to about a tenth of that.
    assert np.abs((mean_shift(points, WIDTHS)[chosen] - truth) / wide).mean() < 0.06


def test_clusters_contract_and_a_uniform_distribution_stays() -> None:
    points = cloud()
    moved = mean_shift(points, WIDTHS)
    assert (moved[:2000].std(0) < 0.5 * points[:2000].std(0)).all()
    np.testing.assert_allclose(moved[:2000].mean(0), points[:2000].mean(0), atol=2e-3)
    even = np.stack(np.meshgrid(np.linspace(0, 1, 200), np.linspace(0, 1, 200)), -1).reshape(-1, 2)
    inner = (np.abs(even - 0.5) < 0.3).all(1)
    assert np.abs((mean_shift(even, WIDTHS) - even)[inner]).max() < 0.003


def test_mean_shift_of_no_point_and_one() -> None:
    assert mean_shift(np.zeros((0, 3)), (0.1,) * 3).shape == (0, 3)
    np.testing.assert_allclose(mean_shift(np.array([[0.2, 0.4, 0.6]]), (0.1,) * 3), [[0.2, 0.4, 0.6]], atol=1e-6)


def test_metals_and_dielectrics_are_separate_and_excluded_texels_stay() -> None:
    base = decode(np.repeat([0.5, 0.52, 0.54], 100)[:, None] * np.ones(3)).astype(np.float32)
    index = np.arange(300)
    roughness, metallic = np.where(index < 100, 0, 0.1).astype(np.float32), np.where(index < 100, METAL_THRESHOLD, 0).astype(np.float32)
    found = common_materials(Materials(base, roughness, metallic), index < 200)
    np.testing.assert_allclose(found[:100], [[0.5, 0.5, 0.5, 0.0]] * 100, atol=1e-3)
    np.testing.assert_allclose(found[100:], np.column_stack([encode(base[100:]), roughness[100:]]), atol=1e-3)
    assert len(KERNEL_WIDTHS) == found.shape[1]


@pytest.fixture(scope="module")
def glossy() -> Sphere:
    return Sphere(0.25)


def with_stains(scene: Sphere, size: float) -> Sphere:
    """The scene with a smooth error of brightness in every photo, as from misplaced reflections."""
    random = np.random.default_rng(0)
    photos = []
    for p in scene.photos:
        wave = sum(random.normal() * np.sin(random.normal(0, 6, 3) @ scene.normal.T + random.uniform(0, 6)) for _ in range(4))
        off = np.einsum("nk,nk->n", p.bilinear, np.asarray(wave)[p.texel])
        photos.append(replace(p, colour=np.clip(p.colour + size * off[:, None], 0, 1).astype(np.float32)))
    other = Sphere.__new__(Sphere)
    other.texels, other.normal, other.base_color, other.photos = scene.texels, scene.normal, scene.base_color, photos
    return other


def colour_deviation(scene: Sphere, priors: Priors) -> float:
    """Median deviation (sRGB) of observed texels from the median of their base colour, mean of both base colours."""
    fitted = after(scene.start(0.2), 200, priors=priors)
    known = observed(fitted)
    red = scene.base_color[:, 0] > 0.3
    shown = encode(fitted.materials.base_color)
    off = [shown[known & kind] - np.median(shown[known & kind], 0) for kind in (red, ~red)]
    return float(np.mean([np.median(np.abs(o)) for o in off]))


def test_prior_removes_stains(glossy: Sphere) -> None:
    stained = with_stains(glossy, 0.04)
    assert colour_deviation(stained, WEAK_PRIORS) < 0.5 * colour_deviation(stained, replace(WEAK_PRIORS, sparsity=0.0))


@pytest.mark.slow
def test_continuous_base_colours_stay() -> None:
    scene = Sphere(0.8, even=True)
    truth = encode(scene.base_color)

    def error(priors: Priors) -> float:
        fitted = after(scene.start(0.8), 200, priors=priors, diffuse=True)
        known = observed(fitted)
        base = fitted.materials.base_color[known]
        gain = (base * scene.base_color[known]).sum(0) / (base**2).sum(0)
        return float(np.abs(encode(base * gain) - truth[known]).mean())

    assert error(WEAK_PRIORS) < error(replace(WEAK_PRIORS, sparsity=0.0)) < 0.05
