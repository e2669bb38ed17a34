"""Base colours solved from photos that are linear in them: clipped pixels, misplaced reflections, robustness."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.materials.linear_shading import (
    CLIPPED,
    NORMAL_ERROR,
    ROBUST_SCALE,
    ROUNDS,
    BaseColourSolver,
    LinearShading,
    PhotoSamples,
    _tilted,
    solve_base_colours,
)

TRUE = np.array([0.8, 0.5, 0.2])


def photo(slope: list[float], offset: list[float], texel: list[int] | None = None) -> tuple[PhotoSamples, LinearShading]:
    """A photo of texels of the base colour `TRUE`, clipped at white, with the shading that explains it."""
    columns = np.ones(3, np.float32)
    shading = LinearShading(np.outer(slope, columns).astype(np.float32), np.outer(offset, columns).astype(np.float32))
    colour = np.clip(TRUE * shading.slope + shading.offset, 0, 1).astype(np.float32)
    n = len(slope)

    where = np.zeros(n, np.int64) if texel is None else np.array(texel)
    return PhotoSamples(where, colour, np.ones(n, np.float32), np.zeros(n, np.int32), lambda roughness, metallic: shading), shading


def solve(*photos: tuple[PhotoSamples, LinearShading], texels: int = 1, lowest: float = 0.0, robust: bool = False) -> NDArray[np.float64]:
    return BaseColourSolver([p for p, _ in photos], texels).solve([s for _, s in photos], lowest, robust)


@pytest.mark.parametrize("robust", [False, True])
def test_pixels_of_several_photos_determine_the_base_colour(robust: bool) -> None:
    found = solve(photo([0.5, 0.9], [0.01, 0.03]), photo([0.2], [0.05]), robust=robust)
    assert found[0] == pytest.approx(TRUE, abs=1e-5)


@pytest.mark.parametrize("robust", [False, True])
def test_clipped_pixels_that_are_explained_do_not_darken(robust: bool) -> None:
    """With a slope of 4 all but the darkest channel are clipped; taken as 1.0 they would ask for a base colour of .25."""
    found = solve(photo([0.5, 4.0, 4.0, 4.0], [0.01] * 4), robust=robust)
    assert found[0] == pytest.approx(TRUE, abs=1e-5)


@pytest.mark.parametrize("robust", [False, True])
def test_where_all_is_clipped_the_base_colour_is_just_bright_enough(robust: bool) -> None:
    found = solve(photo([6.0, 8.0, 7.0], [0.02] * 3), robust=robust)
    assert (found[0] * 6.0 + 0.02 >= CLIPPED - 0.15).all() and (found[0] * 6.0 < 1.1).all()


def test_clipped_pixels_raise_what_leaves_them_too_dark() -> None:
    """One unclipped pixel in a wrong shadow says .08; three clipped ones say more, though dark pixels weigh more."""
    shadow, shading = photo([1.0, 2.0, 2.0, 2.0], [0.0] * 4)
    shadow.colour[0] = 0.08
    assert (solve((shadow, shading))[0, :2] > 0.2).all()


def test_a_predicted_reflection_brighter_than_white_does_not_count() -> None:
    seen, shading = photo([0.5, 0.5, 0.5], [0.01, 0.01, 0.01])
    misplaced = LinearShading(shading.slope, shading.offset + np.float32([[0], [0], [60]]))
    assert solve((seen, misplaced))[0] == pytest.approx(TRUE, abs=1e-5)


def test_the_robust_solution_ignores_one_wrong_pixel() -> None:
    seen, shading = photo([0.5] * 6, [0.01] * 6)
    seen.colour[2] += 0.3
    assert np.abs(solve((seen, shading), robust=True)[0] - TRUE).max() < 0.03
    assert np.abs(solve((seen, shading))[0] - TRUE).max() > 0.05


def test_texels_are_separate_and_unseen_ones_get_the_lowest() -> None:
    found = solve(photo([0.5, 0.5], [0.0, 0.0], [0, 2]), texels=3, lowest=0.1)
    assert found[[0, 2]] == pytest.approx(np.tile(TRUE, (2, 1)), abs=1e-5) and found[1] == pytest.approx(0.1)


@pytest.mark.parametrize("robust", [False, True])
def test_the_solution_equals_that_by_sums_over_arrays(robust: bool) -> None:
    rng, texels, pixels = np.random.default_rng(4), 9, 400
    texel = rng.integers(texels, size=pixels)
    slope, offset, colour = (rng.uniform(0, 1.1, (pixels, 3)).astype(np.float32) for _ in range(3))
    offset *= 0.95
    colour = np.minimum(colour, 1)
    weight = rng.uniform(0.1, 2, (pixels, 3)).astype(np.float32)
    curve = rng.uniform(0.5, 3, (pixels, 3)).astype(np.float32)
    found = np.full((texels, 3), 0.02)
    solve_base_colours(texel, slope, offset, colour, weight, curve, 0.02, ROUNDS, robust, found)

    base, clipped = np.full((texels, 3), 0.02), colour >= CLIPPED
    for turn in range(ROUNDS):
        shown = base[texel] * slope + offset
        used = weight.astype(float) * (offset < CLIPPED) * (~clipped | ((shown < CLIPPED) & (turn > 0)))
        if robust and turn:
            used /= np.maximum(np.abs(shown - colour) * curve, ROBUST_SCALE)
        for k in range(3):
            squares = np.bincount(texel, used[:, k] * slope[:, k].astype(float) ** 2, texels)
            products = np.bincount(texel, used[:, k] * slope[:, k] * (colour - offset)[:, k].astype(float), texels)
            base[:, k] = np.clip(products / squares, 0.02, 1)
    assert clipped.any() and np.allclose(found, base, rtol=1e-5)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 2.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.4)])
def test_tilts_have_the_covariance_of_normals_errors(normal: tuple[float, ...]) -> None:
    """Equal variances along both tangents, none along the normal: that of two tilts by the standard deviation, one along each."""
    unit = np.array(normal) / np.linalg.norm(normal)
    change = _tilted(np.tile(np.array(normal, np.float32), (300, 1))) - unit
    np.testing.assert_allclose(change.T @ change / 300, NORMAL_ERROR**2 * (np.eye(3) - np.outer(unit, unit)), atol=0.01 * NORMAL_ERROR**2)
