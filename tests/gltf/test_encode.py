"""8-bit maps: colour spaces, exact flat normals, precision levels."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from gsbake.gltf.encode import PRECISION_LEVELS, encode_within_budget, halved_to_fit, quantise, size_limit


def pixels(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image)


def test_colour_is_coded_in_srgb_and_the_rest_is_linear() -> None:
    grey = np.full((4, 4, 3), 0.2158605)  # linear value of the sRGB code 128
    maps = quantise(grey, grey, np.tile([0.5, 0.5, 1.0], (4, 4, 1)))
    assert (maps.base_color == 128).all() and (maps.orm == 55).all()
    assert maps.normal is not None and (maps.normal == [128, 128, 255]).all()


def test_the_size_limit_follows_a_finer_base_colour_unless_it_is_set() -> None:
    assert size_limit(0.0, 1024, 1024) == size_limit(0.0, 2048, 2048) == 5
    assert size_limit(0.0, 4096, 1024) == 5 + 3e-6 * (4096**2 - 1024**2)
    assert size_limit(7.5, 4096, 1024) == 7.5


def test_a_large_texture_is_coded_like_a_small_one() -> None:
    column = np.linspace(0, 1, 600)[:, None, None] * np.ones((1, 2, 3))
    maps = quantise(column, np.ones((2, 2, 3)), None)
    assert np.array_equal(maps.base_color[500:], quantise(column[500:], np.ones((2, 2, 3)), None).base_color)
    assert maps.base_color.shape == (600, 2, 3) and maps.orm.shape == (2, 2)


def test_budget_lowers_the_linear_maps_only() -> None:
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(64, 64, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    maps = quantise(rng.random((64, 64, 3)), rng.random((64, 64, 3)), 0.5 * normal + 0.5)
    full, level = encode_within_budget(maps, 10**9)
    assert level is PRECISION_LEVELS[0] and np.array_equal(pixels(full.orm), maps.orm)
    size = len(full.base_color) + len(full.orm) + len(full.normal or b"")
    less, level = encode_within_budget(maps, size - 1)
    assert level is PRECISION_LEVELS[1] and less.base_color == full.base_color
    assert np.abs(pixels(less.orm).astype(int) - maps.orm).max() <= 2
    least, level = encode_within_budget(maps, 0)
    assert level is PRECISION_LEVELS[-1] and pixels(least.normal or b"").shape == (32, 32, 3)
    vector = pixels(least.normal or b"") / 127.5 - 1
    assert np.abs(np.linalg.norm(vector, axis=2) - 1).max() < 0.03


def test_a_base_colour_finer_than_the_other_maps_is_halved_first() -> None:
    rng = np.random.default_rng(0)
    maps = quantise(rng.random((64, 64, 3)), rng.random((16, 16, 3)), None)
    assert len(halved_to_fit(maps, 64 * 64 * 3 + 1000).base_color) == 64
    assert len(halved_to_fit(maps, 32 * 32 * 3 + 1000).base_color) == 32
    assert len(halved_to_fit(maps, 0).base_color) == 16


def test_flat_normals_and_range_ends_are_exact_at_every_level() -> None:
    flat = np.tile([0.5, 0.5, 1.0], (8, 8, 1))
    orm = np.tile([1.0, 0.6, 0.0], (8, 8, 1))
    orm[::2, :, 1] = 0.4
    images, _ = encode_within_budget(quantise(flat, orm, flat), 0)
    assert (pixels(images.normal or b"") == [128, 128, 255]).all()
    assert (pixels(images.orm)[..., [0, 2]] == [255, 0]).all()


def test_constant_roughness_and_metallic_become_factors() -> None:
    orm = np.random.default_rng(0).random((8, 8, 3))
    orm[..., 1:] = np.float16([0.8, 0.0])  # precision of the baked textures
    maps = quantise(orm, orm, None)
    assert maps.factors == (0.8, 0.0)
    images, _ = encode_within_budget(maps, 10**9)
    assert np.array_equal(pixels(images.orm), quantise(orm[..., [0, 0, 0]], orm[..., [0, 0, 0]], None).orm[..., 0])
    orm[3, 3, 1] += 0.01
    assert quantise(orm, orm, None).factors is None
