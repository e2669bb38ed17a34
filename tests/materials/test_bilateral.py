"""The edge-aware filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.materials.surface import FILTER_RADIUS, EdgeAwareFilter, Neighbourhoods, neighbours
from gsbake.texturing.texels import Texels, rasterise

SIZE, SCALE = 64, 0.3


def chart(*corners: tuple[float, float]) -> Texels:
    """The texels of squares of .4 with these corners."""
    uv, faces = [], []
    for x, y in corners:
        faces += [np.array([[0, 1, 2], [0, 2, 3]]) + len(uv)]
        uv += [(x, y), (x + 0.4, y), (x + 0.4, y + 0.4), (x, y + 0.4)]
    return rasterise(np.array(uv), np.concatenate(faces), SIZE)


def make_filter(texels: Texels, colour: NDArray[Any], apart: float = 0.0) -> EdgeAwareFilter:
    """The filter of a texture on a plane, with its right half moved to the right by `apart`."""
    row, column = np.divmod(texels.index, SIZE)
    at = np.column_stack([column + apart * (column >= SIZE / 2), row, np.zeros(len(row))]).astype(float)
    appearance = encode(np.asarray(colour, np.float32))
    return EdgeAwareFilter(texels, neighbours(texels, at, np.tile([0.0, 0.0, 1.0], (len(row), 1))), appearance, SCALE)


def two_colours(texels: Texels, left: float, right: float) -> NDArray[np.float32]:
    column = texels.index % SIZE
    return np.repeat(np.where(column < 0.3 * SIZE, left, right)[:, None], 3, 1).astype(np.float32)


@pytest.mark.parametrize(("right", "crosses"), [(0.5, True), (0.02, False)])
def test_filter_stops_at_colour_edges(right: float, crosses: bool) -> None:
    texels = chart((0.1, 0.1))
    column = texels.index % SIZE
    values = np.where(column < 0.3 * SIZE, 1.0, 0.0)
    filtered = make_filter(texels, two_colours(texels, 0.5, right))(values)
    far = np.abs(column - 0.3 * SIZE) > 5
    assert (filtered[far & (values == 0)].mean() > 0.2) == crosses
    assert (filtered[far & (values == 1)].mean() < 0.8) == crosses


@pytest.mark.parametrize(("apart", "share"), [(0.0, False), (-3.0, True)])
def test_filter_crosses_seams_between_adjacent_charts_only(apart: float, share: bool) -> None:
    texels = chart((0.05, 0.1), (0.5, 0.1))  # three texels between them in the texture
    values = (texels.index % SIZE < SIZE / 2).astype(float)
    filtered = make_filter(texels, np.full((len(texels), 3), 0.5), apart)(values)
    assert (filtered[values == 0].mean() > 0.2) == share
    assert (filtered[values == 1].mean() < 0.8) == share


def test_constants_and_sums_are_preserved() -> None:
    texels, rng = chart((0.1, 0.1)), np.random.default_rng(0)
    filter_ = make_filter(texels, rng.uniform(size=(len(texels), 3)))
    np.testing.assert_allclose(filter_(np.full(len(texels), 0.7)), 0.7, atol=1e-9)
    values = rng.uniform(size=len(texels))
    np.testing.assert_allclose(filter_(values).sum(), values.sum(), rtol=1e-9)


def test_decay_on_a_uniform_colour_follows_the_radius() -> None:
    strip = rasterise(np.array([(0, 0.4), (1, 0.4), (1, 0.5), (0, 0.5)]), np.array([[0, 1, 2], [0, 2, 3]]), 256)
    row, column = np.divmod(strip.index, 256)
    at = np.column_stack([column, row, np.zeros(len(row))]).astype(float)
    filter_ = EdgeAwareFilter(strip, neighbours(strip, at, np.tile([0.0, 0.0, 1.0], (len(row), 1))), np.full((len(row), 3), 0.5), SCALE)
    filtered = filter_((column == 128).astype(float))
    # (1 − FILTER_RADIUS² ∂²) u = δ with reflecting boundaries 127 texels away
    fall = np.cosh((127 - 10) / FILTER_RADIUS) / np.cosh((127 - 40) / FILTER_RADIUS)
    assert filtered[column == 138].mean() / filtered[column == 168].mean() == pytest.approx(fall, rel=0.02)


def test_a_smaller_scale_stops_at_weaker_edges() -> None:
    """Two colours of which the wide filter makes one neighbourhood, and the near one two."""
    texels = chart((0.1, 0.1))
    left = texels.index % SIZE < 0.3 * SIZE
    at = np.column_stack([texels.index % SIZE, texels.index // SIZE, np.zeros(len(left))]).astype(float)
    pairs = neighbours(texels, at, np.tile([0.0, 0.0, 1.0], (len(left), 1)))
    appearance = np.repeat(np.where(left, 0.5, 0.42)[:, None], 3, 1).astype(np.float32)
    wide, near = (EdgeAwareFilter(texels, pairs, appearance, scale)(left.astype(float))[~left].mean() for scale in (0.3, 0.02))
    assert near < 0.5 * wide


def test_near_neighbours_share_the_material_and_wide_ones_the_colour_of_photos() -> None:
    texels = chart((0.1, 0.1))
    left = texels.index % SIZE < 0.3 * SIZE
    at = np.column_stack([texels.index % SIZE, texels.index // SIZE, np.zeros(len(left))]).astype(float)
    pairs = neighbours(texels, at, np.tile([0.0, 0.0, 1.0], (len(left), 1)))
    neighbourhoods = Neighbourhoods(texels, pairs, np.full((len(left), 3), 0.3))
    values = np.column_stack([np.full((len(left), 3), 0.3), np.where(left, 0.1, 0.9)]).astype(np.float32)
    near, wide = (
        average(left.astype(float))[~left].mean() for average in (neighbourhoods.near(values[:, :3], values[:, 3]), neighbourhoods.wide)
    )
    assert near < 0.5 * wide
