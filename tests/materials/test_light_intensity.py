"""Search for intensity, tint and contrast of a light from specular reflection, with unknown base colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode
from gsbake.materials.light_intensity import (
    INTENSITY_FACTOR,
    ROUGHNESS_STEP,
    TINT_FACTOR,
    LightAdjustment,
    adjust_radiance,
    search_light,
    shift_roughness,
)
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.split_sum import shade
from tests.support.linear import linear
from tests.support.monte_carlo import render
from tests.support.slow import slow

Doubles = NDArray[np.float64]
TEXELS, PHOTOS, SIZE = 400, 16, 16
AREA = solid_angles(SIZE)


def room(directions: Doubles) -> Doubles:
    """Radiance of a dim room with a window and a small bright light."""
    window = np.exp(8 * (directions @ np.array([0.8, 0.0, 0.6]) - 1))
    lamp = np.exp(40 * (directions @ np.array([-0.6, 0.64, 0.48]) - 1))
    return (0.15 + 3 * window + 6 * lamp)[:, None] * np.array([1.0, 0.9, 0.8])


TRUE = EnvironmentLight.from_function(room, SIZE).radiance().detach().numpy()


class Plastic:
    """Texels of many base colours and one roughness in many photos; `normal_error` in degrees of the normals used to explain them.

    With `reference` the photos are taken by the Monte Carlo renderer, which shares no code with the search."""

    def __init__(self, normal_error: float = 0.0, single: bool = False, roughness: float = 0.2, reference: bool = False) -> None:
        self.reference = reference
        rng = np.random.default_rng(5)
        self.normal = rng.normal(size=(TEXELS, 3))
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        self.meshed = self.normal + np.radians(normal_error) * rng.normal(size=(TEXELS, 3))
        self.base_color = rng.uniform(0.05, 0.6, (TEXELS, 3)).astype(np.float32)
        self.roughness = np.full(TEXELS, roughness, np.float32)
        self.sides = []
        for _ in range(PHOTOS):
            side = rng.normal(size=3)
            self.sides.append(side / np.linalg.norm(side))
        self.single, self.light = single, TRUE

    def colours(
        self, normal: Doubles, side: Doubles, base: NDArray[np.float32], light: NDArray[np.float32], roughness: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        tables = EnvironmentLight.from_radiance(light).prefilter()
        n, v = (torch.as_tensor(x, dtype=torch.float32) for x in (normal, np.tile(side, (len(normal), 1))))
        with torch.no_grad():
            return np.asarray(shade(n, v, torch.as_tensor(base), torch.as_tensor(roughness), torch.zeros(len(normal)), tables).numpy())

    def samples(self, assumed: NDArray[np.float32]) -> Callable[[Doubles, float], Sequence[PhotoSamples]]:
        """The samples for `search_light` where the present light is `assumed`."""
        photos = []
        for side in self.sides:
            visible = np.flatnonzero(self.normal @ side > 0.2)
            if self.reference:
                view = np.tile(side, (len(visible), 1))
                colour = render(self.normal[visible], view, self.base_color[visible], self.roughness[visible], np.zeros(len(visible)), room)
            else:
                colour = self.colours(self.normal[visible], side, self.base_color[visible], self.light, self.roughness[visible])
            photos.append((side, visible, colour.astype(np.float32)))

        def under(intensity: Doubles, contrast: float) -> list[PhotoSamples]:
            light = adjust_radiance(assumed, intensity, contrast, AREA)
            found = []
            for side, visible, colour in photos:

                def trial(value: float, rough: NDArray[np.float32], metallic: float, side=side, visible=visible) -> NDArray[np.float32]:  # type: ignore[no-untyped-def]
                    return self.colours(self.meshed[visible], side, np.full((len(visible), 3), value, np.float32), light, rough[visible])

                # Blocks of pixels show adjacent texels, here those with similar normals.
                order = np.argsort(np.argsort(self.normal[visible] @ np.array([0.3, 0.5, 0.8])))
                block = order if self.single else order // 25
                found.append(
                    PhotoSamples(visible, np.clip(colour, 0, 1), np.ones(len(visible), np.float32), block.astype(np.int32), linear(trial))
                )
            return found

        return under

    def search(self, assumed: NDArray[np.float32], rough: bool = False, roughness_shift: float = 0.0) -> LightAdjustment:
        """The adjustment found from this light and from roughness shifted by `roughness_shift`."""
        return search_light(self.samples(assumed), shift_roughness(self.roughness, roughness_shift), rough=rough)


def mean(light: NDArray[np.float32]) -> Doubles:
    return np.asarray((light * AREA[..., None]).sum((0, 1, 2)) / AREA.sum(), np.float64)


def test_adjusted_radiance_has_intensity_and_contrast() -> None:
    assert np.allclose(adjust_radiance(TRUE, np.ones(3), 1.0, AREA), TRUE, rtol=1e-5)
    other = adjust_radiance(TRUE, np.array([1.0, 2.0, 0.5]), 1.5, AREA)
    assert mean(other) == pytest.approx(mean(TRUE) * [1.0, 2.0, 0.5], rel=1e-4)
    ratio = np.log(other[0, 3, 4] / other[2, 8, 8]) / np.log(TRUE[0, 3, 4] / TRUE[2, 8, 8])
    assert ratio == pytest.approx(1.5, rel=1e-4)


def test_true_light_is_unchanged() -> None:
    found = Plastic().search(TRUE)
    assert np.allclose(found.intensity, 1) and found.contrast == 1 and found.improvement == 0


@pytest.mark.parametrize("factor", [slow(1.0), 1.7, slow(0.6)])
def test_light_of_reference_photos_is_recovered(factor: float) -> None:
    found = Plastic(reference=True).search(adjust_radiance(TRUE, np.full(3, factor), 1.0, AREA))
    assert found.intensity * factor == pytest.approx(np.ones(3), rel=INTENSITY_FACTOR**1.5 - 1)
    assert 0.75 < found.contrast < 1.35


@pytest.mark.parametrize("factor", [1.7, 0.6, INTENSITY_FACTOR**0.5])
def test_wrong_intensity_is_corrected(factor: float) -> None:
    """To a small part of a step, of which the true one need not be a multiple."""
    found = Plastic().search(adjust_radiance(TRUE, np.full(3, factor), 1.0, AREA))
    assert found.intensity * factor == pytest.approx(np.ones(3), rel=0.04)
    assert found.improvement > 0.3 or abs(np.log(factor)) < 0.2
    assert f"residual -{found.improvement:.1%}" in str(found)


def test_uniform_component_is_removed() -> None:
    assumed = np.asarray(TRUE + 0.4, np.float32)
    found = Plastic().search(assumed)
    assert found.contrast > 1.3
    adjusted = adjust_radiance(assumed, found.intensity, found.contrast, AREA)
    assert np.abs(np.log(mean(adjusted) / mean(TRUE))).max() < 0.6 * np.abs(np.log(mean(assumed) / mean(TRUE))).max()


def test_tint_of_one_channel_is_corrected() -> None:
    found = Plastic().search(adjust_radiance(TRUE, np.array([1.0, 1.0, TINT_FACTOR]), 1.0, AREA))
    assert found.intensity == pytest.approx(np.array([1, 1, 1 / TINT_FACTOR]))


def test_roughness_shift_is_in_logits() -> None:
    adjustment = LightAdjustment(np.ones(3), 1.0, np.log(3.0), 0.1)
    assert adjustment.shifted_roughness(np.array([0.5, 0.25, 0.0, 1.0])) == pytest.approx([0.75, 0.5, 0, 1], abs=1e-3)
    assert "roughness logit +1.1" in str(adjustment)


def test_true_roughness_is_unchanged() -> None:
    found = Plastic().search(TRUE, rough=True)
    assert found.roughness_shift == 0 and found.improvement == 0


@pytest.mark.parametrize(("true", "wrong"), [slow(0.2, -0.8), (0.85, -2.0)])
def test_too_low_roughness_is_corrected(true: float, wrong: float) -> None:
    """Not by a dimmer, more uniform light, which would hide the reflections of the smoother material."""
    plastic = Plastic(roughness=true)
    found = plastic.search(TRUE, rough=True, roughness_shift=wrong)
    assert found.roughness_shift == pytest.approx(-wrong, abs=ROUGHNESS_STEP + 1e-6)
    assert found.intensity == pytest.approx(np.ones(3), rel=INTENSITY_FACTOR - 1)
    assert plastic.search(TRUE, rough=False, roughness_shift=wrong).roughness_shift == 0


def test_dim_uniform_light_on_smooth_material_becomes_bright_light_on_rough_material() -> None:
    assumed = adjust_radiance(TRUE, np.full(3, 0.6), 0.6, AREA)
    found = Plastic(roughness=0.9).search(assumed, rough=True, roughness_shift=-2.4)
    assert found.roughness_shift > 1.2
    assert found.intensity.mean() * 0.6 > 0.8


@pytest.mark.parametrize(("depth", "there"), [(0.05, True), (0.1, False)])
def test_second_search_finds_a_clearly_deeper_minimum(depth: float, there: bool) -> None:
    """One pixel with a synthetic error: .1 at an intensity one step lower, `depth` at 1.7 times the intensity and higher roughness."""

    def error(steps: float, roughness_shift: float) -> float:
        near = 0.1 + 0.02 * (abs(steps + 1) + abs(roughness_shift))
        far = depth + 0.02 * (abs(steps - 3) + abs(roughness_shift - 2.0))
        hill = 0.3 if 0 < roughness_shift < 1.5 else 0.0
        return min(near, far) + hill

    def under(intensity: Doubles, contrast: float) -> list[PhotoSamples]:
        steps = float(np.log(intensity[0]) / np.log(INTENSITY_FACTOR))

        def shown(base: float, roughness: NDArray[np.float32], metallic: float) -> NDArray[np.float32]:
            roughness_shift = float(np.log(roughness[0] / (1 - roughness[0])))
            return decode(np.full((1, 3), 0.3 + error(steps, roughness_shift) + 0.01 * abs(contrast - 1), np.float32))

        colour = decode(np.full((1, 3), 0.3, np.float32))
        return [PhotoSamples(np.zeros(1, np.int64), colour, np.ones(1, np.float32), np.zeros(1, np.int32), linear(shown))]

    found = search_light(under, np.full(1, 0.5, np.float32), tint=False)
    assert (found.roughness_shift > 1.5) == there
    assert found.intensity[0] == pytest.approx(INTENSITY_FACTOR**3 if there else 1 / INTENSITY_FACTOR)


def test_misplaced_reflections_do_not_darken_the_light() -> None:
    together, alone = Plastic(normal_error=8), Plastic(normal_error=8, single=True)
    assert together.search(TRUE).intensity.mean() > 0.9
    assert alone.search(TRUE).intensity.mean() < 0.9


def test_an_overexposed_light_is_unchanged() -> None:
    """Most pixels of the photos are clipped at white under three times the light; the search keeps it."""

    def search(light: NDArray[np.float32]) -> LightAdjustment:
        bright = Plastic()
        bright.base_color = np.random.default_rng(6).uniform(0.3, 0.8, (TEXELS, 3)).astype(np.float32)
        bright.light = light
        return bright.search(light)

    found = search(3 * TRUE)
    assert found.intensity == pytest.approx(np.ones(3), rel=0.1)
