"""Base colour of metals finer than the photos' pixels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from gsbake.materials.linear_shading import LinearParts, LinearShading, PhotoSamples, unclipped_weights
from gsbake.materials.metal_superresolution import (
    HUE_RADIUS,
    MetalPixels,
    _correlated,
    _metal_colour,
    _metal_or_black,
    _photo_systems,
    _solve,
    _with_local_hue,
    metal_regions,
    superresolved,
)
from gsbake.materials.surface import Materials
from gsbake.texturing.texels import Texels

SIZE = 32


def solved(values: NDArray[np.float32], texels: Texels, region: NDArray[np.bool_], photos: list[MetalPixels]) -> NDArray[np.float32]:
    """`superresolved` of values (n, 5): base colour, roughness, metallic."""
    out = superresolved(Materials(values[:, :3], values[:, 3], values[:, 4]), texels, region, photos)
    return np.column_stack([out.base_color, out.roughness, out.metallic])


GOLD = np.array([0.9, 0.7, 0.4], np.float32)
ROW, COLUMN = np.divmod(np.arange(SIZE * SIZE), SIZE)
#: Perforated metal: which texels are holes, its base colour, and which texels lie well inside the photos.
HOLE = (COLUMN % 6 < 3) & (ROW % 6 < 3)
PERFORATED = np.where(HOLE[:, None], 0.0, GOLD).astype(np.float32)
INNER = (np.minimum(COLUMN, ROW) > 3) & (np.maximum(COLUMN, ROW) < SIZE - 5)


def full_texture() -> Texels:
    n = SIZE * SIZE
    return Texels(SIZE, np.arange(n), np.zeros(n, np.int32), np.zeros((n, 3), np.float32), np.ones(n, bool))


def photos(base: NDArray[np.float32], count: int = 30, noise: float = 0.0, grids: int = 3) -> list[MetalPixels]:
    """Photos whose pixels are the means of squares of 3 x 3 texels, each photo with a reflection and one of `grids`² grids."""
    rng = np.random.default_rng(5)
    out = []
    for _ in range(count):
        x, y = (rng.integers(0, grids) + 3 * np.arange(SIZE // 3 - 1) for _ in range(2))
        corner = (y[:, None] * SIZE + x).ravel()
        texel = (corner[:, None] + np.array([i * SIZE + j for i in range(3) for j in range(3)])).astype(np.int64)
        slope = np.repeat(rng.uniform(0.1, 0.9, (len(corner), 1)), 3, 1).astype(np.float32)
        offset = np.full_like(slope, 0.02)
        colour = slope * base[texel].mean(1) + offset + rng.normal(scale=noise, size=slope.shape)
        weight, block = np.ones(len(corner), np.float32), np.zeros(len(corner), np.int32)
        samples = PhotoSamples(texel[:, 4], colour.astype(np.float32), weight, block, never)
        column, row = (at.ravel() for at in np.meshgrid(np.arange(len(x)), np.arange(len(y))))
        out.append(MetalPixels(column, row, texel, np.ones(texel.shape, bool), samples, LinearShading(slope, offset)))
    return out


def never(roughness: NDArray[np.float32]) -> LinearParts:
    raise AssertionError("shading is known")


def test_perforation_finer_than_pixels_is_recovered() -> None:
    texels = full_texture()
    values = np.tile(np.append(PERFORATED.mean(0), [0.2, 0.8]).astype(np.float32), (len(texels), 1))
    values[::2, 3] = 0.3
    region = np.ones(len(texels), bool)
    out = solved(values, texels, region, photos(PERFORATED, 60, 0.002))
    before, after = (np.abs(x[INNER, :3] - PERFORATED[INNER]).mean() for x in (values, out))
    assert after < 0.15 * before
    assert (out[INNER & HOLE, 4] == 0).all() and (out[INNER & ~HOLE, 4] == 1).all()
    np.testing.assert_array_equal(out[:, 3], np.where(out[:, 4] == 1, values[:, 3], 1))
    values[:, 3] = 0.2
    assert (solved(values, texels, region, photos(PERFORATED, 60, 0.002))[:, 3] == values[:, 3]).all()


@pytest.mark.parametrize("period", [4, 5])
def test_small_holes_are_found_though_photos_blur_them_to_grey(period: int) -> None:
    hole = (COLUMN % period < 2) & (ROW % period < 2)
    base = np.where(hole[:, None], 0.0, GOLD).astype(np.float32)
    values = np.concatenate([np.tile((1 - hole.mean()) * GOLD, (len(hole), 1)), np.full((len(hole), 1), 0.3), np.ones((len(hole), 1))], 1)
    out = solved(values.astype(np.float32), full_texture(), np.ones(len(hole), bool), photos(base, noise=0.01))
    assert ((out[:, 4] < 0.5) == hole)[INNER].mean() > 0.85


@pytest.mark.slow
def test_solver_approaches_bounded_least_squares() -> None:
    """One value per row of texels in the middle channel, against SciPy's solver."""
    rng = np.random.default_rng(0)
    texels = full_texture()
    n = len(texels)
    truth = np.repeat(np.repeat(rng.uniform(0.2, 0.9, n // 16), 16)[:, None], 3, 1).astype(np.float32)
    metal_pixels = photos(truth, 40)
    values = np.concatenate([np.full((n, 3), 0.5, np.float32), np.zeros((n, 1), np.float32), np.ones((n, 1), np.float32)], 1)
    out = _solve(_photo_systems(metal_pixels, np.ones(n, bool)), values[:, :3])
    rows, right = [], []
    for photo in metal_pixels:
        weight = np.sqrt(unclipped_weights(photo.samples)[:, 1])
        matrix = np.zeros((len(weight), n))
        np.put_along_axis(matrix, photo.texel, 1 / 9, 1)
        rows.append(matrix * (weight * photo.shading.slope[:, 1])[:, None])
        right.append(weight * (photo.samples.colour - photo.shading.offset)[:, 1])
    best = lsq_linear(np.concatenate(rows), np.concatenate(right), (0, 1)).x
    covered = np.abs(np.concatenate(rows)).sum(0) > 1

    def left(base: NDArray[np.floating]) -> float:
        return float(np.square(np.concatenate(rows) @ base - np.concatenate(right)).sum())

    assert covered.mean() > 0.8
    assert left(out[:, 1]) < 0.05 * left(values[:, 1])
    assert left(best) < left(out[:, 1])


def test_hue_is_averaged_and_brightness_is_kept() -> None:
    texels = full_texture()
    rng = np.random.default_rng(1)
    bright = rng.uniform(0.3, 0.8, (len(texels), 1))
    hue_noise = (bright * GOLD / GOLD.mean() * rng.uniform(0.8, 1.2, (len(texels), 3))).clip(0, 1).astype(np.float32)
    out = _with_local_hue(hue_noise, texels, np.ones(len(texels), bool))
    inner = np.minimum(COLUMN, ROW) > HUE_RADIUS
    hue = out[inner] / out[inner].mean(1, keepdims=True)
    assert hue.std(0).max() < 0.3 * (hue_noise[inner] / hue_noise[inner].mean(1, keepdims=True)).std(0).max()
    assert np.abs(out - hue_noise).mean(1)[inner].mean() < 0.08
    np.testing.assert_allclose(out[inner].mean(1), hue_noise[inner].mean(1), atol=0.05)


def test_solid_metal_and_dielectrics_are_unchanged() -> None:
    texels = full_texture()
    values = np.random.default_rng(2).uniform(0.2, 0.8, (len(texels), 5)).astype(np.float32)
    region = COLUMN < SIZE // 2
    even = np.full((len(texels), 3), 0.7, np.float32)
    np.testing.assert_array_equal(solved(values, texels, region, photos(even)), values)
    pierced = even * ~HOLE[:, None]
    out = solved(values, texels, region, photos(pierced.astype(np.float32)))
    np.testing.assert_array_equal(out[~region], values[~region])
    assert (out[region] != values[region]).mean() > 0.5


def test_detail_that_photos_do_not_determine_is_no_pattern() -> None:
    """Bars a third of a pixel wide in the fitted base colour, and photos of even metal, whose pixels all lie on one grid."""
    texels = full_texture()
    values = np.tile(np.array([0.9, 0.9, 0.9, 0.2, 0.8], np.float32), (len(texels), 1))
    values[COLUMN % 3 == 0, :3] = 0
    even = np.full((len(texels), 3), 0.6, np.float32)
    np.testing.assert_array_equal(solved(values, texels, np.ones(len(texels), bool), photos(even, noise=0.01, grids=1)), values)


def test_dark_patches_that_no_photo_shows_are_no_holes() -> None:
    """Larger than the smoothing of the start: both halves keep them, and agree."""
    texels, patch = full_texture(), ((np.arange(SIZE**2) // SIZE // 8) % 2 == 0) & ((COLUMN // 8) % 2 == 0)
    values = np.tile(np.array([0.9, 0.9, 0.9, 0.2, 0.8], np.float32), (len(texels), 1))
    values[patch, :3] = 0.05
    even, region = np.full((len(texels), 3), 0.6, np.float32), np.ones(len(texels), bool)
    for seen in ([], photos(even, count=1)):
        np.testing.assert_array_equal(solved(values, texels, region, seen), values)


def test_binary_prior_reduces_noise() -> None:
    texels = full_texture()
    all_texels = np.ones(len(texels), bool)
    values = np.tile(np.array([0.4, 0.4, 0.4, 0.2, 0.8], np.float32), (len(texels), 1))
    metal_pixels = photos(PERFORATED, 30, 0.08)
    alone = _solve(_photo_systems(metal_pixels, all_texels), values[:, :3])
    drawn = solved(values, texels, all_texels, metal_pixels)[:, :3]
    before, after = (np.abs(x[INNER] - PERFORATED[INNER]).mean() for x in (alone, drawn))
    assert after < 0.7 * before


@pytest.mark.parametrize("bright", [0.9, 0.15])
def test_binary_prior_is_local_metal_or_black(bright: float) -> None:
    texels = full_texture()
    shown = np.where(HOLE[:, None], 0.15 * bright * GOLD, bright * GOLD).astype(np.float32)
    out = _metal_or_black(shown, texels, np.ones(len(texels), bool))
    assert (out[HOLE] == 0).all()
    np.testing.assert_allclose(out[~HOLE], np.tile(bright * GOLD, (int((~HOLE).sum()), 1)), rtol=0.02)


def test_share_of_blurred_bars_is_kept() -> None:
    texels = full_texture()
    x, y = COLUMN / 5.3, ROW / 6.1
    bar = np.hypot(x - np.round(x), y - np.round(y)) > 0.35
    sharp = np.where(bar[:, None], GOLD, 0).astype(np.float32)
    shown = cv2.GaussianBlur(texels.image(sharp), (0, 0), 1.5).reshape(-1, 3)
    all_texels = np.ones(len(texels), bool)
    inner = (np.minimum(COLUMN, ROW) > 6) & (np.maximum(COLUMN, ROW) < SIZE - 7)
    out, metal = _metal_or_black(shown, texels, all_texels), _metal_colour(shown, texels, all_texels)
    halves = np.where(2 * shown.mean(1, keepdims=True) > metal.mean(1, keepdims=True), metal, 0)
    assert out[inner].mean() == pytest.approx(shown[inner].mean(), rel=0.06)
    assert halves[inner].mean() > 1.12 * shown[inner].mean()


def test_gains_of_photos_do_not_change_the_pattern() -> None:
    texels = full_texture()
    values = np.tile(np.append(PERFORATED.mean(0), [0.2, 0.8]).astype(np.float32), (len(texels), 1))
    rng = np.random.default_rng(6)
    metal_pixels = []
    for photo in photos(PERFORATED, 60, 0.002):
        off = np.float32(2 ** rng.uniform(-1, 1))
        metal_pixels.append(replace(photo, shading=LinearShading(off * photo.shading.slope, off * photo.shading.offset)))
    out = solved(values, texels, np.ones(len(texels), bool), metal_pixels)
    assert (out[INNER & HOLE, 4] == 0).mean() > 0.98 and (out[INNER & ~HOLE, 4] == 1).mean() > 0.95
    assert np.abs(out[INNER, :3] - PERFORATED[INNER]).mean() < 0.3 * np.abs(values[INNER, :3] - PERFORATED[INNER]).mean()


def test_pattern_must_be_in_both_halves() -> None:
    texels = full_texture()
    rng = np.random.default_rng(7)
    same, one, other = rng.uniform(0.2, 0.8, (3, len(texels))).astype(np.float32)
    all_texels = np.ones(len(texels), bool)
    assert _correlated(texels, all_texels, all_texels, 0.6 * same + 0.4 * one, 0.6 * same + 0.4 * other).all()
    assert not _correlated(texels, all_texels, all_texels, one, other).any()


@pytest.mark.parametrize(("share", "region"), [(0.6, True), (0.1, False)])
def test_pattern_is_one_region(share: float, region: bool) -> None:
    texels = full_texture()
    metal = np.random.default_rng(3).uniform(size=len(texels)) < share
    assert (metal_regions(texels, metal).mean() > 0.9) == region
