"""Adjacency of texels, within charts and across seams."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.materials.surface import neighbours
from gsbake.texturing.texels import Texels, rasterise

SIZE = 64
#: Upper left corners in the texture of two charts of .3 × .4, and the left edge of each on a plane.
CHARTS, EDGES = ((0.05, 0.1), (0.5, 0.5)), (0.0, 0.3)


def two_charts(gap: float = 0.0, charts: tuple[tuple[float, float], ...] = CHARTS) -> tuple[Texels, NDArray[np.float64]]:
    """Two halves of a rectangle, `gap` apart, one chart each; the texels and their positions."""
    square, faces = np.array([(0, 0), (0.3, 0), (0.3, 0.4), (0, 0.4)]), np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.concatenate([square + corner for corner in charts])
    flat = np.concatenate([square + [x + gap * (x > 0), 0] for x in EDGES])
    texels = rasterise(uv, np.concatenate([faces, faces + 4]), SIZE)
    position = np.column_stack([flat, np.zeros(8)])
    return texels, np.asarray(texels.interpolate(position, np.concatenate([faces, faces + 4])), np.float64)


def crossing(texels: Texels, pairs: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which pairs (m,) join the two charts."""
    chart = texels.face >= 2
    return np.asarray(chart[pairs[:, 0]] != chart[pairs[:, 1]])


UP = np.array([0.0, 0.0, 1.0])


def test_pairs_are_a_texel_apart_and_unique() -> None:
    texels, at = two_charts()
    pairs = neighbours(texels, at, np.tile(UP, (len(texels), 1)))
    assert np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1).max() < 1.6 / SIZE
    assert len(np.unique(np.sort(pairs, 1), axis=0)) == len(pairs)


def test_seam_is_joined_along_the_whole_edge() -> None:
    texels, at = two_charts()
    pairs = neighbours(texels, at, np.tile(UP, (len(texels), 1)))
    across = pairs[crossing(texels, pairs)]
    np.testing.assert_allclose(at[across][..., 0], 0.3, atol=1.6 / SIZE)
    rows = np.unique(np.round(at[across][..., 1] * SIZE))
    assert len(rows) >= 0.4 * SIZE - 2


@pytest.mark.parametrize("turned", [UP, -UP])
def test_opposite_side_of_a_sheet_is_not_adjacent(turned: NDArray[np.float64]) -> None:
    texels, at = two_charts()
    normal = np.where((texels.face >= 2)[:, None], turned, UP)
    assert crossing(texels, neighbours(texels, at, normal)).any() == (turned[2] > 0)


def test_charts_packed_side_by_side_are_not_adjacent() -> None:
    texels, at = two_charts(gap=0.2, charts=((0.05, 0.1), (0.35, 0.1)))
    row, column = np.divmod(texels.index, SIZE)
    assert len(np.unique(column[row == row.min() + 5])) == len(np.unique(column))  # no gap in the texture
    assert not crossing(texels, neighbours(texels, at, np.tile(UP, (len(texels), 1)))).any()
