"""Averages that stop at edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.materials.adjacency import neighbours
from gsbake.materials.bilateral import REACH, Alike
from gsbake.texturing.texels import Texels, rasterise

SIZE = 64


def chart(*corners: tuple[float, float]) -> Texels:
    """The texels of squares of .4 with these corners."""
    uv, faces = [], []
    for x, y in corners:
        faces += [np.array([[0, 1, 2], [0, 2, 3]]) + len(uv)]
        uv += [(x, y), (x + 0.4, y), (x + 0.4, y + 0.4), (x, y + 0.4)]
    return rasterise(np.array(uv), np.concatenate(faces), SIZE)


def alike(texels: Texels, shown: NDArray[Any], apart: float = 0.0) -> Alike:
    """The filter where the texture lies on a plane, its right half moved `apart`, or to the left where that is negative."""
    row, column = np.divmod(texels.index, SIZE)
    at = np.column_stack([column + apart * (column >= SIZE / 2), row, np.zeros(len(row))]).astype(float)
    return Alike(texels, neighbours(texels, at, np.tile([0.0, 0.0, 1.0], (len(row), 1))), shown)


def paint(texels: Texels, left: float, right: float) -> NDArray[np.float32]:
    column = texels.index % SIZE
    return np.repeat(np.where(column < 0.3 * SIZE, left, right)[:, None], 3, 1).astype(np.float32)


@pytest.mark.parametrize(("right", "crosses"), [(0.5, True), (0.02, False)])
def test_votes_cross_one_colour_and_stop_at_an_edge(right: float, crosses: bool) -> None:
    texels = chart((0.1, 0.1))
    column = texels.index % SIZE
    votes = np.where(column < 0.3 * SIZE, 1.0, 0.0)
    shared = alike(texels, paint(texels, 0.5, right))(votes)
    far = np.abs(column - 0.3 * SIZE) > 5
    assert (shared[far & (votes == 0)].mean() > 0.2) == crosses
    assert (shared[far & (votes == 1)].mean() < 0.8) == crosses


@pytest.mark.parametrize(("apart", "share"), [(0.0, False), (-3.0, True)])
def test_charts_share_across_a_seam_only(apart: float, share: bool) -> None:
    texels = chart((0.05, 0.1), (0.5, 0.1))  # three texels between them in the texture
    votes = (texels.index % SIZE < SIZE / 2).astype(float)
    shared = alike(texels, np.full((len(texels), 3), 0.5), apart)(votes)
    assert (shared[votes == 0].mean() > 0.2) == share
    assert (shared[votes == 1].mean() < 0.8) == share


def test_what_is_even_stays_and_nothing_is_lost() -> None:
    texels, rng = chart((0.1, 0.1)), np.random.default_rng(0)
    same = alike(texels, rng.uniform(size=(len(texels), 3)))
    np.testing.assert_allclose(same(np.full(len(texels), 0.7)), 0.7, atol=1e-9)
    votes = rng.uniform(size=len(texels))
    np.testing.assert_allclose(same(votes).sum(), votes.sum(), rtol=1e-9)


def test_along_one_colour_votes_fall_off_with_the_reach() -> None:
    strip = rasterise(np.array([(0, 0.4), (1, 0.4), (1, 0.5), (0, 0.5)]), np.array([[0, 1, 2], [0, 2, 3]]), 256)
    row, column = np.divmod(strip.index, 256)
    at = np.column_stack([column, row, np.zeros(len(row))]).astype(float)
    same = Alike(strip, neighbours(strip, at, np.tile([0.0, 0.0, 1.0], (len(row), 1))), np.full((len(row), 3), 0.5))
    shared = same((column == 128).astype(float))
    # (1 − REACH² ∂²) u = δ between walls 127 texels away, through which nothing goes
    fall = np.cosh((127 - 10) / REACH) / np.cosh((127 - 40) / REACH)
    assert shared[column == 138].mean() / shared[column == 168].mean() == pytest.approx(fall, rel=0.02)
