"""Texels against positions known by construction."""

from __future__ import annotations

import numpy as np

from gsbake.texturing.texels import overlapping, rasterise

QUAD = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
FACES = np.array([[0, 2, 1], [0, 3, 2]])


def test_quad_interpolates_its_coordinates() -> None:
    texels = rasterise(QUAD, FACES, 16)
    centre = np.stack([(texels.index % 16 + 0.5) / 16, (texels.index // 16 + 0.5) / 16], 1)
    shown = texels.interpolate(QUAD, FACES)
    assert np.allclose(shown[texels.inside], centre[texels.inside], atol=1e-6)
    assert texels.inside.sum() == 64
    # Texels around it take the nearest point of the quad.
    assert np.allclose(shown[~texels.inside], np.clip(centre[~texels.inside], 0.25, 0.75), atol=1e-6)
    assert (~texels.inside).sum() == 32 + 4


def test_image_places_values_at_texels() -> None:
    texels = rasterise(QUAD, FACES, 16)
    image = texels.image(texels.interpolate(QUAD, FACES), empty=-1)
    assert np.allclose(image[6, 9], [9.5 / 16, 6.5 / 16])
    assert image[0, 0, 0] == -1
    assert texels.covered().sum() == len(texels)


def test_overlaps_are_counted_once_per_texel() -> None:
    assert overlapping(QUAD, FACES, 64) == 0
    shifted = np.concatenate([QUAD, QUAD + [0.25, 0]])
    both = np.concatenate([FACES, FACES + 4])
    # 16 x 32 texels are shared; those on a diagonal, 16 of either quad, lie on an edge and not in a triangle.
    assert overlapping(shifted, both, 64) == 16 * 32 - 32


def test_degenerate_triangle_is_skipped() -> None:
    assert len(rasterise(np.array([[0.1, 0.1], [0.5, 0.5], [0.9, 0.9]]), np.array([[0, 1, 2]]), 32)) == 0
