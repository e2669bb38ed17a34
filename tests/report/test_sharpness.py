"""Texels per pixel, and the part of a photo that the page shows beside the asset at full size."""

from __future__ import annotations

from typing import Any

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
