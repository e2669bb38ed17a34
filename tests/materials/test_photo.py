"""Photos as reads of a texture: which texels pixels show, and exposures divided out of them."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode, encode
from gsbake.materials.photo import Photo, PhotoReader
from gsbake.texturing.texels import rasterise
from tests.materials.test_fit import cameras, sphere


def test_pixels_read_the_texture_at_the_ray_hit() -> None:
    mesh, uv = sphere()
    texels = rasterise(uv, mesh.faces, 256)
    at = texels.interpolate(np.asarray(mesh.vertices), mesh.faces)
    camera = cameras(1, 64)[0]
    mask = np.zeros((64, 64), np.uint8)
    mask[:, :40] = 255
    reader = PhotoReader(RayCaster(mesh.vertices, mesh.faces, 1), uv, texels, at, 2.0)
    pixels = reader.read(camera, np.zeros((64, 64, 3), np.uint8), mask)
    point = np.einsum("nk,nkc->nc", pixels.bilinear, at[pixels.texel])
    pixel_position, _ = camera.project(point)
    assert len(pixels) > 500
    # Points of the texture project back onto pixel centres, left of the mask's boundary.
    assert np.abs(pixel_position - np.floor(pixel_position) - 0.5).max() < 0.1
    assert pixel_position[:, 0].max() < 39.5
    assert np.allclose(pixels.view, (camera.centre - point) / np.linalg.norm(camera.centre - point, axis=1, keepdims=True), atol=0.01)
    assert np.allclose(pixels.bilinear.sum(1), 1)
    np.testing.assert_allclose(pixels.normal, point, atol=1e-6)
    assert len(reader.read(camera, np.zeros((64, 64, 3), np.uint8), mask, max_pixels=100)) <= 100


def test_gain_is_divided_out_of_linear_colour() -> None:
    one = np.ones((1, 3), np.float32)
    photo = Photo(np.zeros((1, 4), np.int32), np.full((1, 4), 0.25, np.float32), one, one, encode(np.array([[0.4, 0.2, 0.1]])),
                  np.ones(1, np.float32), np.zeros(1, np.int32), np.zeros(1, np.int64))  # fmt: skip
    equal = photo.without_gain(np.array([2.0, 1.0, 0.5]), np.array([0.5, 0.5, 0.5]))
    assert decode(equal.colour) == pytest.approx(np.array([[0.2, 0.2, 0.2]]), abs=1e-5) and equal.weight == photo.weight


@pytest.mark.parametrize(("gain", "weighs"), [(2.0, False), (1.0, False), (0.5, True)])
def test_what_is_clipped_in_a_brighter_photo_hardly_weighs(gain: float, weighs: bool) -> None:
    one, colour = np.ones((2, 3), np.float32), encode(np.array([[1.0, 0.9, 0.9], [0.5, 0.5, 0.5]]))
    photo = Photo(np.zeros((2, 4), np.int32), np.full((2, 4), 0.25, np.float32), one, one, colour, np.ones(2, np.float32),
                  np.zeros(2, np.int32), np.arange(2))  # fmt: skip
    weight = photo.without_gain(gain * np.ones(3), 0.5 * np.ones(3)).weight
    assert weight[1] == 1 and (weight[0] == 1) == weighs and weight[0] > 0
