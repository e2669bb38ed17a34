"""Noise of metals' base colours: what halves of the photos do not share is taken out, what they share stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.materials.base_color_noise import without_noise
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.materials.surface import Materials, neighbours
from gsbake.texturing.texels import Texels, rasterise
from tests.support.linear import linear

SIZE, PHOTOS = 64, 12


class Plate:
    """A plate whose texels each show in all photos under uniform light, with base colours that each photo sees with an error of its own."""

    def __init__(self, pattern: float, error: float) -> None:
        uv, faces = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
        self.texels: Texels = rasterise(uv, faces, SIZE)
        corners = np.column_stack([uv, np.zeros(4)])
        position = self.texels.interpolate(corners, faces)
        self.pairs = neighbours(self.texels, position, np.tile(np.float32([0, 0, 1]), (len(position), 1)))
        rng, n = np.random.default_rng(0), len(position)
        # A fine print, and errors of photos that extend over a few texels as those of normals do.
        self.truth = (0.5 + pattern * np.sin(40 * position[:, :1]) * np.ones(3)).astype(np.float32)
        self.photos = [self._photo(self.truth * (1 + error * self._field(rng, position))) for _ in range(PHOTOS)]
        seen = np.mean([photo.colour for photo in self.photos], 0)
        self.values = np.column_stack([seen, np.full(n, 0.3), np.full(n, 0.9)])

    @staticmethod
    def _field(rng: np.random.Generator, position: NDArray[np.float32]) -> NDArray[np.float64]:
        wave = rng.normal(size=(8, 2)) * 12
        return np.asarray(np.sin(position[:, :2] @ wave.T + rng.uniform(0, 6, 8)).mean(1)[:, None] * 2)

    @staticmethod
    def _photo(colour: NDArray[np.floating]) -> PhotoSamples:
        n = len(colour)

        def shade(base: float, roughness: NDArray[np.float32], metallic: float) -> NDArray[np.float32]:
            return np.full((n, 3), base, np.float32)

        return PhotoSamples(np.arange(n), np.float32(colour), np.ones(n, np.float32), np.zeros(n, np.int32), linear(shade))

    def error(self, base: NDArray[np.floating]) -> float:
        """Root mean square of sRGB values."""
        return float(np.sqrt(np.square(encode(np.clip(base, 0, 1)) - encode(self.truth)).mean()))

    def filtered(self, metal: bool = True) -> NDArray[np.float64]:
        materials = Materials(self.values[:, :3], self.values[:, 3], self.values[:, 4])
        return without_noise((self.photos[::2], self.photos[1::2]), materials, np.full(len(self.values), metal), self.texels, self.pairs)


def test_noise_on_a_uniform_metal_is_taken_out() -> None:
    plate = Plate(pattern=0.0, error=0.2)
    assert plate.error(plate.filtered()) < 0.35 * plate.error(plate.values[:, :3])


def test_a_print_that_all_photos_show_stays() -> None:
    plate = Plate(pattern=0.2, error=0.02)
    assert plate.error(plate.filtered()) < 1.2 * plate.error(plate.values[:, :3])
    contrast = np.std(plate.filtered()[:, 0]) / np.std(plate.truth[:, 0])
    assert contrast == pytest.approx(1, abs=0.05)


def test_the_share_that_stays_follows_from_the_variances() -> None:
    """Print and noise of equal variance: half of the deviation from the mean stays. A little less, as robust solutions vary more."""
    plate = Plate(pattern=0.02, error=0.0)
    rng, level = np.random.default_rng(1), np.std(plate.truth[:, 0]) * np.sqrt(PHOTOS)
    plate.photos = [
        replace(photo, colour=plate.truth + np.float32(level * rng.normal(size=(len(plate.truth), 1)))) for photo in plate.photos
    ]
    plate.values[:, :3] = np.mean([photo.colour for photo in plate.photos], 0)
    before, after = (encode(base) - encode(base).mean() for base in (plate.values[:, :3], plate.filtered()))
    share = (after * before).sum() / np.square(before).sum()
    assert 0.2 < share < 0.6


def test_dielectrics_keep_their_base_colours() -> None:
    plate = Plate(pattern=0.1, error=0.2)
    np.testing.assert_array_equal(plate.filtered(metal=False), plate.values[:, :3])


def test_one_photo_tells_no_noise() -> None:
    plate = Plate(pattern=0.1, error=0.2)
    plate.photos = plate.photos[:1]
    np.testing.assert_array_equal(plate.filtered(), plate.values[:, :3])
