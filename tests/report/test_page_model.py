"""The asset in the page: whole where there is room, else the same mesh with smaller images."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.gltf.document import Document
from gsbake.gltf.read import parse_glb
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.imaging.png import encode_png
from gsbake.report.page_model import page_model


def asset() -> bytes:
    """A triangle with noisy textures of 256²."""
    rng = np.random.default_rng(0)
    smooth = np.repeat(np.repeat(rng.integers(40, 200, (16, 16, 3)), 16, 0), 16, 1)
    colour = np.asarray(smooth + rng.integers(0, 20, (256, 256, 3)), np.uint8)
    position = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    normal, tangent = np.tile(np.float32([0, 0, 1]), (3, 1)), np.tile(np.float32([1, 0, 0, 1]), (3, 1))
    uv = np.array([[0, 1], [1, 1], [0, 0]], np.float32)
    images = GltfTextures(encode_png(colour), encode_png(colour[::-1].copy()), encode_png(np.full_like(colour, 128)))
    return build_glb(GltfMesh(position, normal, tangent, uv, np.array([[0, 1, 2]], np.int32)), images, "asset", "test")


def test_an_asset_with_room_stays_as_it_is() -> None:
    data = asset()
    assert page_model(data, len(data)) is data


@pytest.mark.parametrize("share", [0.6, 0.1])
def test_images_shrink_until_the_asset_fits(share: float) -> None:
    data = asset()
    small = page_model(data, int(share * len(data)))
    assert len(small) <= share * len(data)
    before, after = (parse_glb(content, "x") for content in (data, small))
    assert np.array_equal(before.faces, after.faces)
    assert all(np.array_equal(before.attributes[key], after.attributes[key]) for key in before.attributes)
    one, two = (file.image("base_color") for file in (before, after))
    assert one is not None and two is not None
    step = one.shape[0] // two.shape[0]
    mean = one.reshape(two.shape[0], step, two.shape[1], step, 3).mean((1, 3))
    assert np.abs(mean - two).mean() < 6
    kinds = {entry["mimeType"] for entry in Document.parse(small, "x").json["images"]}
    assert "image/jpeg" in kinds


def test_what_cannot_fit_is_as_small_as_it_gets() -> None:
    data = asset()
    assert len(page_model(data, 10)) == len(page_model(data, 11)) < 0.1 * len(data)
