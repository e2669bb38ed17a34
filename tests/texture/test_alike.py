"""Averages that stop at edges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.texture.alike import Alike
from gsbake.texture.texels import Texels, rasterise

SIZE = 64


def chart(*corners: tuple[float, float]) -> Texels:
    """The texels of squares of .4 with these corners."""
    uv, faces = [], []
    for x, y in corners:
        faces += [np.array([[0, 1, 2], [0, 2, 3]]) + len(uv)]
        uv += [(x, y), (x + 0.4, y), (x + 0.4, y + 0.4), (x, y + 0.4)]
    return rasterise(np.array(uv), np.concatenate(faces), SIZE)


def paint(texels: Texels, left: float, right: float) -> NDArray[np.float32]:
    column = texels.index % SIZE
    return np.repeat(np.where(column < 0.3 * SIZE, left, right)[:, None], 3, 1).astype(np.float32)


@pytest.mark.parametrize(("right", "crosses"), [(0.5, True), (0.02, False)])
def test_votes_cross_one_colour_and_stop_at_an_edge(right: float, crosses: bool) -> None:
    texels = chart((0.1, 0.1))
    column = texels.index % SIZE
    votes = np.where(column < 0.3 * SIZE, 1.0, 0.0)
    shared = Alike(texels, paint(texels, 0.5, right))(votes)
    far = np.abs(column - 0.3 * SIZE) > 5
    assert (shared[far & (votes == 0)].mean() > 0.2) == crosses
    assert (shared[far & (votes == 1)].mean() < 0.8) == crosses


def test_charts_of_one_colour_do_not_share() -> None:
    texels = chart((0.05, 0.1), (0.5, 0.1))
    votes = (texels.index % SIZE < 0.47 * SIZE).astype(float)
    shared = Alike(texels, np.full((len(texels), 3), 0.5, np.float32))(votes)
    assert shared[votes == 0].max() < 0.1 and shared[votes == 1].min() > 0.9


def test_what_is_even_stays() -> None:
    texels = chart((0.1, 0.1))
    shared = Alike(texels, np.random.default_rng(0).uniform(size=(len(texels), 3)))(np.full(len(texels), 0.7))
    np.testing.assert_allclose(shared, 0.7, atol=0.02)
