"""Texels per pixel, and the part of a photo that the page shows beside the asset at full size."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.posed_photos import View
from gsbake.imaging.srgb import encode_bytes
from gsbake.report import sharpness
from gsbake.report.render import Renderer, unlit
from gsbake.report.sharpness import close_up, sharpest_square, texel_density
from tests.report.shapes import front_camera, quad


def test_texels_per_pixel_and_per_millimetre() -> None:
    asset = quad(np.full((256, 256, 3), 0.5))  # 256 texels on 2 units
    cameras = [front_camera(distance, 800, 400) for distance in (2.0, 4.0, 6.0)]  # a pixel is 1/100 of a unit at the median distance
    assert texel_density(asset, cameras, False).value == "1.3 per pixel"
    assert texel_density(asset, cameras, True).note == "of a photo; 0.128 per mm"


def test_the_sharpest_square_lies_on_the_object() -> None:
    rng = np.random.default_rng(0)
    rgb = np.full((600, 900, 3), 128, np.uint8)
    rgb[:, 700:] = rng.integers(0, 255, (600, 200, 3))  # background
    rgb[320:400, 200:280] = rng.integers(60, 200, (80, 80, 3))
    alpha = np.zeros((60, 90), np.float32)
    alpha[10:55, 5:65] = 1
    found = sharpest_square(rgb, alpha, 100)
    assert found is not None
    left, top = found
    assert 172 <= left <= 208 and 292 <= top <= 328
    assert sharpest_square(rgb, np.zeros_like(alpha), 100) is None


def test_close_up_shows_the_same_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    base = np.full((64, 64, 3), 0.3)
    base[40:56, 8:24] = rng.uniform(0.1, 0.9, (16, 16, 1))
    renderer, camera = Renderer(quad(base)), front_camera(4, 512, 1024)  # 8 pixels per texel
    drawn = renderer.draw(camera, unlit)

    class Photos:
        def view(self, index: int) -> View:
            return View(camera, encode_bytes(drawn.linear), np.full((512, 512), 255, np.uint8))

    shown: list[np.ndarray] = []
    monkeypatch.setattr(sharpness, "EDGE", 128)
    monkeypatch.setattr(sharpness, "image_uri", lambda image: shown.append(image) or "data:,")
    photos: Any = Photos()
    panels = close_up(renderer, unlit, photos, camera.scaled(256, 256), 0)
    assert [panel.title for panel in panels] == ["front", "Asset"] and panels[0].caption == "128 × 128 of 512 × 512 pixels"
    photo, render = shown
    assert photo.std() > 0.1 and np.abs(photo - render).max() < 0.01


def test_detail_is_compared_in_squares() -> None:
    """Left half as sharp as the photo, right half with a third of its contrast; nothing where the photo is plain or the object ends."""
    rng, square = np.random.default_rng(2), sharpness.MAP_SQUARE
    photo = np.repeat(rng.uniform(0.3, 0.7, (8 * square, 8 * square, 1)), 3, 2)
    photo[:, : square + 4] = 0.5
    render = photo.copy()
    render[:, 4 * square :] = 0.5 + (photo[:, 4 * square :] - 0.5) / 3
    whole = np.ones(photo.shape[:2], np.bool_)
    whole[: 2 * square] = False
    ratio = sharpness.detail_ratio(photo, render, whole)
    assert ratio.shape == (8, 8) and np.isnan(ratio[:2]).all() and np.isnan(ratio[:, 0]).all()
    np.testing.assert_allclose(ratio[3:7, 2], 1, atol=1e-4)
    np.testing.assert_allclose(ratio[3:7, 5:7], 1 / 3, atol=1e-4)


def test_the_map_of_detail_says_its_median(monkeypatch: pytest.MonkeyPatch) -> None:
    """The photo shows twice the contrast of the asset: half of its detail everywhere, the colour of the middle of the scale."""
    base = np.random.default_rng(1).uniform(0.2, 0.4, (512, 512, 1)).repeat(3, 2)
    camera = front_camera(4, 512, 1024)
    sharp, dull = (Renderer(quad(image)) for image in (base, base.mean() + (base - base.mean()) / 2))
    photo = View(camera, encode_bytes(sharp.draw(camera, unlit).linear), np.full((512, 512), 255, np.uint8))

    class Photos:
        def view(self, index: int, max_size: int) -> View:
            return photo

    shown: list[np.ndarray] = []
    monkeypatch.setattr(sharpness, "image_uri", lambda image: shown.append(image) or "data:,")
    photos: Any = Photos()
    (panel,) = sharpness.detail_panel(dull, unlit, photos, camera.scaled(256, 256), 0)
    assert float(panel.caption.split(": ")[1].split()[0]) == pytest.approx(0.5, abs=0.05)
    height, width = shown[0].shape[:2]
    middle = cv2.applyColorMap(np.full((1, 1), 127, np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0, ::-1] / 255
    assert np.abs(shown[0][height // 2, width // 2] - middle).max() < 0.1
    photo.rgb[:] = 128
    assert not sharpness.detail_panel(dull, unlit, photos, camera, 0)
