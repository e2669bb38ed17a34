"""Metal detection under a known light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats

from gsbake.imaging.srgb import encode
from gsbake.materials.linear_shading import LinearParts, LinearShading, PhotoSamples, Shader
from gsbake.materials.metallic import MIN_METAL_ALBEDO, MIN_PHOTOS, find_metals, majority_vote, pixel_costs
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.split_sum import shade
from tests.support.linear import linear
from tests.support.monte_carlo import render

TEXELS, PHOTOS = 60, 24


def windows(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance of a room with four windows of different colours."""
    out = np.full((len(directions), 3), 0.1)
    for k, (axis, colour) in enumerate(
        (((1, 0, 0.3), (4, 3, 2)), ((-1, 0.5, 0), (1, 3, 4)), ((0, -1, 0.4), (3, 3, 3)), ((0, 0.2, 1), (2, 4, 2)))
    ):
        toward = np.asarray(axis) / np.linalg.norm(axis)
        out += np.exp((10 + 5 * k) * (directions @ toward - 1))[:, None] * np.asarray(colour)
    return out


class Wall:
    """Texels with individual normals under one light, in many photos."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        self.tables = EnvironmentLight.from_function(windows, 16).prefilter()
        normal = rng.normal(size=(TEXELS, 3))
        self.normal = torch.as_tensor(normal / np.linalg.norm(normal, axis=1, keepdims=True), dtype=torch.float32)
        self.towards = []
        for _ in range(PHOTOS):
            side = torch.nn.functional.normalize(torch.as_tensor(rng.normal(size=(TEXELS, 3)), dtype=torch.float32), dim=1)
            self.towards.append(torch.nn.functional.normalize(side + 1.3 * self.normal, dim=1))

    def colours(self, towards: torch.Tensor, base: NDArray[np.float32], rough: NDArray[np.float32], metallic: float) -> NDArray[np.float32]:
        with torch.no_grad():
            constant = (torch.as_tensor(base), torch.as_tensor(rough), torch.full((TEXELS,), metallic))
            return np.asarray(shade(self.normal, towards, *constant, self.tables).numpy())

    def photos(self, base: NDArray[np.float32], roughness: float, metallic: float) -> list[PhotoSamples]:
        """Photos of a material, with functions that shade any other."""
        found = []
        for towards in self.towards:

            def shaded(value: float, rough: NDArray[np.float32], metal: float, towards: torch.Tensor = towards) -> NDArray[np.float32]:
                return self.colours(towards, np.full((TEXELS, 3), value, np.float32), rough, metal)

            colour = self.colours(towards, base, np.full(TEXELS, roughness, np.float32), metallic)
            found.append(PhotoSamples(np.arange(TEXELS), colour, np.ones(TEXELS, np.float32), np.zeros(TEXELS, np.int32), linear(shaded)))
        return found

    def reference(self, base: NDArray[np.float32], roughness: float, metallic: float) -> list[PhotoSamples]:
        """The same with photos of the Monte Carlo renderer, which shares no code with the detection."""
        normal = self.normal.numpy().astype(np.float64)
        shown = [render(normal, t.numpy(), base, np.full(TEXELS, roughness), np.full(TEXELS, metallic), windows) for t in self.towards]
        return [replace(e, colour=c.astype(np.float32)) for e, c in zip(self.photos(base, roughness, metallic), shown, strict=True)]


@pytest.fixture(scope="module")
def wall() -> Wall:
    return Wall()


@pytest.mark.slow
def test_metals_in_reference_photos(wall: Wall) -> None:
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))
    metals = find_metals(wall.reference(gold, 0.35, 1.0), np.full(TEXELS, 0.8, np.float32))
    assert len(metals.texel) == TEXELS
    assert np.abs(metals.base - gold).mean() < 0.05
    assert np.abs(metals.roughness - 0.35).max() < 0.21  # the next value tried
    dielectric = np.random.default_rng(1).uniform(0.1, 0.8, (TEXELS, 3)).astype(np.float32)
    for roughness in (0.1, 0.35, 0.9):
        assert len(find_metals(wall.reference(dielectric, roughness, 0.0), np.full(TEXELS, roughness, np.float32)).texel) == 0


def test_metal_is_detected_with_colour_and_roughness(wall: Wall) -> None:
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))
    metals = find_metals(wall.photos(gold, 0.35, 1.0), np.full(TEXELS, 0.8, np.float32))
    assert len(metals.texel) == TEXELS
    np.testing.assert_allclose(metals.base, gold, atol=1e-3)  # no noise: least squares is exact
    np.testing.assert_allclose(metals.roughness, 0.35)


@pytest.mark.parametrize("roughness", [0.1, 0.35, 0.9])
def test_dielectric_is_not_metal(wall: Wall, roughness: float) -> None:
    dielectric = np.random.default_rng(1).uniform(0.1, 0.8, (TEXELS, 3)).astype(np.float32)
    assert len(find_metals(wall.photos(dielectric, roughness, 0.0), np.full(TEXELS, roughness, np.float32)).texel) == 0


def test_glossy_black_is_not_metal(wall: Wall) -> None:
    black = np.full((TEXELS, 3), 0.004, np.float32)
    photos = wall.photos(black, 0.1, 0.0)
    # A metal of base colour .04 looks nearly like glossy black: only the lower bound of metals excludes it.
    assert MIN_METAL_ALBEDO > 0.04
    assert len(find_metals(photos, np.full(TEXELS, 0.5, np.float32)).texel) == 0


def test_texels_with_little_weight_are_undecided(wall: Wall) -> None:
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))
    weight = np.where(np.arange(TEXELS) < 5, 1e-3, 1).astype(np.float32)
    dim = [replace(e, weight=weight) for e in wall.photos(gold, 0.2, 1.0)]
    found = find_metals(dim, np.full(TEXELS, 0.2, np.float32))
    assert found.texel.min() == 5


def test_texels_in_few_photos_are_undecided(wall: Wall) -> None:
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))
    photos = wall.photos(gold, 0.2, 1.0)
    own = np.full(TEXELS, 0.2, np.float32)
    assert len(find_metals(photos[: MIN_PHOTOS - 1], own).texel) == 0
    assert len(find_metals(photos[:MIN_PHOTOS], own).texel) == TEXELS


def test_neighbours_decide_together(wall: Wall) -> None:
    """One texel of metal among dielectrics is outvoted, and one dielectric among metal; the metal keeps its own colour."""
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))
    own = np.full(TEXELS, 0.2, np.float32)
    metal, dielectric = wall.photos(gold, 0.2, 1.0), wall.photos(gold, 0.2, 0.0)

    def global_sum(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.full(TEXELS, values.sum())

    for few, many, found in ((metal, dielectric, 0), (dielectric, metal, TEXELS)):
        mixed = [replace(m, colour=np.where(np.arange(TEXELS)[:, None] == 7, f.colour, m.colour)) for f, m in zip(few, many, strict=True)]
        assert len(find_metals(mixed, own, global_sum, global_sum).texel) == found


def test_near_neighbours_decide_where_they_tell(wall: Wall) -> None:
    """Twenty texels of metal among many dielectrics of their colour: their own neighbourhood finds them; where it cannot tell, which is
    simulated by evidence that cancels out, all decide together."""
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))
    own, few = np.full(TEXELS, 0.2, np.float32), np.arange(TEXELS) < TEXELS // 8
    metal, dielectric = wall.photos(gold, 0.2, 1.0), wall.photos(gold, 0.2, 0.0)
    mixed = [replace(m, colour=np.where(few[:, None], m.colour, d.colour)) for m, d in zip(metal, dielectric, strict=True)]

    def everywhere(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.full(TEXELS, values.mean())

    def kind(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(few, values[few].mean(), values[~few].mean())

    def untold(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.zeros(TEXELS) if values.min() < 0 else everywhere(values)  # votes and weights are not negative, likelihood ratios are

    assert np.array_equal(find_metals(mixed, own, kind, everywhere).texel, np.flatnonzero(few))
    assert len(find_metals(mixed, own, untold, everywhere).texel) == 0


def test_majority_vote_removes_isolated_texels() -> None:
    place = np.arange(40)
    kernel = np.exp(-np.abs(place[:, None] - place) / 3.0)
    better = (place >= 20) & (place != 30) | (place == 8)
    known = place != 35
    found = majority_vote(better, known, lambda x: kernel @ x)
    np.testing.assert_array_equal(np.flatnonzero(found), [*range(20, 35), *range(36, 40)])


def brightened(shade: Shader, exposure: float) -> Shader:
    """The shading under a brighter light."""

    def shaded(roughness: NDArray[np.float32]) -> LinearParts:
        parts = shade(roughness)
        return LinearParts(*(LinearShading(exposure * kind.slope, exposure * kind.offset) for kind in (parts.dielectric, parts.metal)))

    return shaded


def test_clipped_pixels_do_not_hide_a_metal(wall: Wall) -> None:
    gold = np.tile(np.array([1.0, 0.77, 0.34], np.float32), (TEXELS, 1))

    def four_times(e: PhotoSamples) -> PhotoSamples:
        return replace(e, colour=np.minimum(4 * e.colour, 1), shade=brightened(e.shade, 4))

    photos = [four_times(e) for e in wall.photos(gold, 0.2, 1.0)]
    assert np.mean([e.colour >= 1 for e in photos]) > 0.3
    found = find_metals(photos, np.full(TEXELS, 0.2, np.float32))
    assert len(found.texel) == TEXELS
    np.testing.assert_allclose(found.base, gold, atol=1e-3)


@pytest.mark.parametrize("exposure", [4.0, 30.0])
def test_overexposed_white_is_not_metal(wall: Wall, exposure: float) -> None:
    """Where all photos are clipped at white, they do not tell a base colour; that is no reason to take it for black metal."""
    white = np.full((TEXELS, 3), 0.8, np.float32)

    def exposed(e: PhotoSamples) -> PhotoSamples:
        colour = np.minimum(exposure * e.colour, 1)
        return replace(e, colour=colour, shade=brightened(e.shade, exposure))

    photos = [exposed(e) for e in wall.photos(white, 0.2, 0.0)]
    clipped = np.mean([e.colour >= 1 for e in photos])
    assert clipped > (0.95 if exposure > 10 else 0.5)
    assert len(find_metals(photos, np.full(TEXELS, 0.2, np.float32)).texel) == 0


def test_costs_of_pixels_are_those_of_students_t() -> None:
    """Against SciPy's density, whose constant they lack; the scale is that of the noise and of the change by two tilts."""
    rng, n = np.random.default_rng(4), 40
    texel, shown, base = rng.integers(0, 9, n), rng.uniform(0, 1, (n, 3)).astype(np.float32), rng.uniform(0.1, 0.9, (9, 3))
    slope, offset = (rng.uniform(0, high, (3, n, 3)).astype(np.float32) for high in (0.9, 0.2))
    cost = np.empty(n, np.float32)
    pixel_costs(texel, shown, slope, offset, base, np.float32(1e-4), np.float32(3), cost)
    plain, *tilted = encode(base[texel] * slope + offset).astype(np.float64)
    scale = np.sqrt(1e-4 + sum(np.square(one - plain) for one in tilted))
    expected = stats.t.logpdf(shown, 3, plain, scale) - stats.t.logpdf(0, 3)
    np.testing.assert_allclose(cost, -expected.sum(1), rtol=1e-3, atol=1e-3)
