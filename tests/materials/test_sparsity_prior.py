"""Texels are drawn to the materials that are common, and only where photos leave room for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode, encode
from gsbake.materials.fit import FitSchedule, Priors
from gsbake.materials.sparsity_prior import METAL, NEAR, common, shifted
from tests.materials.test_fit import FREE, Scene

WIDTHS = (0.03, 0.05)


def cloud(seed: int = 0) -> NDArray[np.float64]:
    """Two tight heaps and a few hundred points all over."""
    random = np.random.default_rng(seed)
    heaps = [random.normal(at, 0.02, (2000, 2)) for at in ((0.3, 0.5), (0.7, 0.4))]
    return np.concatenate([*heaps, random.uniform(0, 1, (400, 2))])


def test_means_are_those_of_a_gaussian() -> None:
    points = cloud()
    asked = np.random.default_rng(1).choice(len(points), 60, replace=False)
    # Writing and reading linearly each add the variance of a hat, a sixth of the grid's step squared.
    wide = np.asarray(WIDTHS) * np.sqrt(1 + 2 / 6)
    weight = np.exp(-0.5 * (((points[asked, None] - points[None]) / wide) ** 2).sum(2))
    truth = weight @ points / weight.sum(1, keepdims=True)
    # A grid of one deviation reads a Gaussian to about a tenth of that.
    assert np.abs((shifted(points, WIDTHS)[asked] - truth) / wide).mean() < 0.06


def test_heaps_gather_and_an_even_spread_stays() -> None:
    points = cloud()
    moved = shifted(points, WIDTHS)
    assert (moved[:2000].std(0) < 0.5 * points[:2000].std(0)).all()
    np.testing.assert_allclose(moved[:2000].mean(0), points[:2000].mean(0), atol=2e-3)
    even = np.stack(np.meshgrid(np.linspace(0, 1, 200), np.linspace(0, 1, 200)), -1).reshape(-1, 2)
    inner = (np.abs(even - 0.5) < 0.3).all(1)
    assert np.abs((shifted(even, WIDTHS) - even)[inner]).max() < 0.003


def test_no_points_and_one() -> None:
    assert shifted(np.zeros((0, 3)), (0.1,) * 3).shape == (0, 3)
    np.testing.assert_allclose(shifted(np.array([[0.2, 0.4, 0.6]]), (0.1,) * 3), [[0.2, 0.4, 0.6]], atol=1e-6)


def test_metal_and_paint_do_not_mix_and_the_uncounted_stay() -> None:
    values = np.zeros((300, 5), np.float32)
    values[:, :3] = decode(np.full((300, 3), 0.5))
    values[:100, 4], values[100:, 3] = METAL, 0.1
    values[100:200, :3] = decode(np.full((100, 3), 0.52))
    values[200:, :3] = decode(np.full((100, 3), 0.54))
    counted = np.arange(300) < 200
    found = common(values, counted)
    np.testing.assert_allclose(found[:100], [[0.5, 0.5, 0.5, 0.0]] * 100, atol=1e-3)
    np.testing.assert_allclose(found[100:], np.column_stack([encode(values[100:, :3]), values[100:, 3]]), atol=1e-3)
    assert len(NEAR) == found.shape[1]


@pytest.fixture(scope="module")
def glossy() -> Scene:
    return Scene(0.25)


def stains(scene: Scene, size: float) -> Scene:
    """The scene with every photo's brightness off by a smooth pattern of its own: what misplaced reflections do."""
    random = np.random.default_rng(0)
    photos = []
    for p in scene.photos:
        wave = sum(random.normal() * np.sin(random.normal(0, 6, 3) @ scene.normal.T + random.uniform(0, 6)) for _ in range(4))
        off = np.einsum("nk,nk->n", p.share, np.asarray(wave)[p.texel])
        photos.append(replace(p, colour=np.clip(p.colour + size * off[:, None], 0, 1).astype(np.float32)))
    other = Scene.__new__(Scene)
    other.texels, other.normal, other.paint, other.photos = scene.texels, scene.normal, scene.paint, photos
    return other


def paint_spread(scene: Scene, priors: Priors) -> float:
    """How uneven (sRGB) each of the two paints ends up where photos show it: the median distance from its median colour."""
    fitted = scene.fit(0.2, priors).run(scene.photos, [], FitSchedule(200))
    known = fitted.weight > 0.3
    red = scene.paint[:, 0] > 0.3
    shown = encode(fitted.values[:, :3])
    off = [shown[known & kind] - np.median(shown[known & kind], 0) for kind in (red, ~red)]
    return float(np.mean([np.median(np.abs(o)) for o in off]))


def test_stained_paint_becomes_even(glossy: Scene) -> None:
    stained = stains(glossy, 0.04)
    assert paint_spread(stained, FREE) < 0.5 * paint_spread(stained, replace(FREE, parsimony=0.0))


def test_paints_of_every_shade_stay() -> None:
    scene = Scene(0.8, even=True)
    truth = encode(scene.paint)

    def error(priors: Priors) -> float:
        fitted = scene.fit(0.8, priors).run(scene.photos, [], FitSchedule(200, diffuse=True))
        known = fitted.weight > 0.3
        gain = (fitted.values[known, :3] * scene.paint[known]).sum(0) / (fitted.values[known, :3] ** 2).sum(0)
        return float(np.abs(encode(fitted.values[known, :3] * gain) - truth[known]).mean())

    assert error(FREE) < error(replace(FREE, parsimony=0.0)) < 0.05
