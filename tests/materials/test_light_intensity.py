"""The brightness, tint and contrast of a light found from what gloss reflects of it, with the paint unknown."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode
from gsbake.materials.light_intensity import BRIGHTER, ROUGHER, TINT, Level, find_level, graded, roughened
from gsbake.materials.metallic import Evidence
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.split_sum import shade
from tests.support.monte_carlo import render

Doubles = NDArray[np.float64]
TEXELS, PHOTOS, SIZE = 400, 16, 16
AREA = solid_angles(SIZE)


def room(directions: Doubles) -> Doubles:
    """A dim room with a window and a lamp."""
    window = np.exp(8 * (directions @ np.array([0.8, 0.0, 0.6]) - 1))
    lamp = np.exp(40 * (directions @ np.array([-0.6, 0.64, 0.48]) - 1))
    return (0.15 + 3 * window + 6 * lamp)[:, None] * np.array([1.0, 0.9, 0.8])


TRUE = EnvironmentLight.from_function(room, SIZE).radiance().detach().numpy()


class Plastic:
    """Texels of many paints and one gloss, seen from many sides; `off` degrees by which the normals that explain them are wrong.

    With `reference` the photos are taken by the Monte Carlo renderer, which shares no code with what explains them."""

    def __init__(self, off: float = 0.0, single: bool = False, roughness: float = 0.2, reference: bool = False) -> None:
        self.reference = reference
        rng = np.random.default_rng(5)
        self.normal = rng.normal(size=(TEXELS, 3))
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        self.meshed = self.normal + np.radians(off) * rng.normal(size=(TEXELS, 3))
        self.paint = rng.uniform(0.05, 0.6, (TEXELS, 3)).astype(np.float32)
        self.roughness = np.full(TEXELS, roughness, np.float32)
        self.sides = []
        for _ in range(PHOTOS):
            side = rng.normal(size=3)
            self.sides.append(side / np.linalg.norm(side))
        self.single = single

    def colours(
        self, normal: Doubles, side: Doubles, base: NDArray[np.float32], light: NDArray[np.float32], gloss: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        tables = EnvironmentLight.from_radiance(light).prefilter()
        n, v = (torch.as_tensor(x, dtype=torch.float32) for x in (normal, np.tile(side, (len(normal), 1))))
        with torch.no_grad():
            return np.asarray(shade(n, v, torch.as_tensor(base), torch.as_tensor(gloss), torch.zeros(len(normal)), tables).numpy())

    def evidence(self, believed: NDArray[np.float32]) -> Callable[[Doubles, float], Sequence[Evidence]]:
        """What `find_level` asks for when the light is `believed`."""
        photos = []
        for side in self.sides:
            seen = np.flatnonzero(self.normal @ side > 0.2)
            if self.reference:
                view = np.tile(side, (len(seen), 1))
                colour = render(self.normal[seen], view, self.paint[seen], self.roughness[seen], np.zeros(len(seen)), room)
            else:
                colour = self.colours(self.normal[seen], side, self.paint[seen], TRUE, self.roughness[seen])
            photos.append((side, seen, colour.astype(np.float32)))

        def under(brightness: Doubles, contrast: float) -> list[Evidence]:
            light = graded(believed, brightness, contrast, AREA)
            found = []
            for side, seen, colour in photos:

                def trial(value: float, rough: NDArray[np.float32], metallic: float, side=side, seen=seen) -> NDArray[np.float32]:  # type: ignore[no-untyped-def]
                    return self.colours(self.meshed[seen], side, np.full((len(seen), 3), value, np.float32), light, rough[seen])

                # Blocks of pixels show texels that lie side by side, here those with normals alike.
                order = np.argsort(np.argsort(self.normal[seen] @ np.array([0.3, 0.5, 0.8])))
                block = order if self.single else order // 25
                found.append(Evidence(seen, np.clip(colour, 0, 1), np.ones(len(seen), np.float32), block.astype(np.int32), trial))
            return found

        return under

    def level(self, believed: NDArray[np.float32], rough: bool = False, rougher: float = 0.0) -> Level:
        """The level found by one who believes in this light and in paint `rougher` than it is."""
        return find_level(self.evidence(believed), roughened(self.roughness, rougher), rough=rough)


def mean(light: NDArray[np.float32]) -> Doubles:
    return np.asarray((light * AREA[..., None]).sum((0, 1, 2)) / AREA.sum(), np.float64)


def test_graded_light_has_the_brightness_and_the_contrast_asked_for() -> None:
    assert np.allclose(graded(TRUE, np.ones(3), 1.0, AREA), TRUE, rtol=1e-5)
    other = graded(TRUE, np.array([1.0, 2.0, 0.5]), 1.5, AREA)
    assert mean(other) == pytest.approx(mean(TRUE) * [1.0, 2.0, 0.5], rel=1e-4)
    ratio = np.log(other[0, 3, 4] / other[2, 8, 8]) / np.log(TRUE[0, 3, 4] / TRUE[2, 8, 8])
    assert ratio == pytest.approx(1.5, rel=1e-4)


def test_the_right_light_stays() -> None:
    found = Plastic().level(TRUE)
    assert np.allclose(found.brightness, 1) and found.contrast == 1 and found.gain == 0


@pytest.mark.parametrize("factor", [1.0, 1.7, 0.6])
def test_the_light_of_reference_photos_comes_back(factor: float) -> None:
    found = Plastic(reference=True).level(graded(TRUE, np.full(3, factor), 1.0, AREA))
    assert found.brightness * factor == pytest.approx(np.ones(3), rel=BRIGHTER**1.5 - 1)
    assert 0.75 < found.contrast < 1.35


@pytest.mark.parametrize("factor", [1.7, 0.6])
def test_a_light_too_bright_or_too_dim_comes_back(factor: float) -> None:
    found = Plastic().level(graded(TRUE, np.full(3, factor), 1.0, AREA))
    assert found.brightness * factor == pytest.approx(np.ones(3), rel=BRIGHTER - 1)
    assert found.gain > 0.3
    assert f"({found.gain:.1%} less unexplained)" in str(found)


def test_an_even_glow_that_paint_made_up_for_goes() -> None:
    believed = np.asarray(TRUE + 0.4, np.float32)
    found = Plastic().level(believed)
    assert found.contrast > 1.3
    level = graded(believed, found.brightness, found.contrast, AREA)
    assert np.abs(np.log(mean(level) / mean(TRUE))).max() < 0.6 * np.abs(np.log(mean(believed) / mean(TRUE))).max()


def test_one_colour_alone_is_found_out() -> None:
    found = Plastic().level(graded(TRUE, np.array([1.0, 1.0, TINT]), 1.0, AREA))
    assert found.brightness == pytest.approx(np.array([1, 1, 1 / TINT]))


def test_roughness_shifts_by_its_odds() -> None:
    level = Level(np.ones(3), 1.0, np.log(3.0), 0.1)
    assert level.roughened(np.array([0.5, 0.25, 0.0, 1.0])) == pytest.approx([0.75, 0.5, 0, 1], abs=1e-3)
    assert "rougher by +1.1" in str(level)


def test_right_roughness_stays() -> None:
    found = Plastic().level(TRUE, rough=True)
    assert found.rougher == 0 and found.gain == 0


@pytest.mark.parametrize(("true", "wrong"), [(0.2, -0.8), (0.85, -2.0)])
def test_paint_taken_for_too_smooth_comes_back(true: float, wrong: float) -> None:
    """Not by a light made dim and even, which would hide the reflections that paint so smooth would show."""
    plastic = Plastic(roughness=true)
    found = plastic.level(TRUE, rough=True, rougher=wrong)
    assert found.rougher == pytest.approx(-wrong, abs=ROUGHER + 1e-6)
    assert found.brightness == pytest.approx(np.ones(3), rel=BRIGHTER - 1)
    assert plastic.level(TRUE, rough=False, rougher=wrong).rougher == 0


def test_dim_even_light_on_smooth_paint_goes_to_the_bright_one_on_rough_paint() -> None:
    believed = graded(TRUE, np.full(3, 0.6), 0.6, AREA)
    found = Plastic(roughness=0.9).level(believed, rough=True, rougher=-2.4)
    assert found.rougher > 1.2
    assert found.brightness.mean() * 0.6 > 0.8


@pytest.mark.parametrize(("depth", "there"), [(0.05, True), (0.1, False)])
def test_valley_behind_a_hill_is_found_where_it_is_clearly_deeper(depth: float, there: bool) -> None:
    """One pixel whose error is laid out by hand: .1 at a light dimmer by a step, `depth` at 1.7 times the light on rougher paint."""

    def error(steps: float, rougher: float) -> float:
        near = 0.1 + 0.02 * (abs(steps + 1) + abs(rougher))
        far = depth + 0.02 * (abs(steps - 3) + abs(rougher - 2.0))
        hill = 0.3 if 0 < rougher < 1.5 else 0.0
        return min(near, far) + hill

    def under(brightness: Doubles, contrast: float) -> list[Evidence]:
        steps = float(np.log(brightness[0]) / np.log(BRIGHTER))

        def shown(base: float, roughness: NDArray[np.float32], metallic: float) -> NDArray[np.float32]:
            rougher = float(np.log(roughness[0] / (1 - roughness[0])))
            return decode(np.full((1, 3), 0.3 + error(steps, rougher) + 0.01 * abs(contrast - 1), np.float32))

        colour = decode(np.full((1, 3), 0.3, np.float32))
        return [Evidence(np.zeros(1, np.int64), colour, np.ones(1, np.float32), np.zeros(1, np.int32), shown)]

    found = find_level(under, np.full(1, 0.5, np.float32), tint=False)
    assert (found.rougher > 1.5) == there
    assert found.brightness[0] == pytest.approx(BRIGHTER**3 if there else 1 / BRIGHTER)


def test_reflections_a_little_off_do_not_ask_for_a_darker_light() -> None:
    together, alone = Plastic(off=6), Plastic(off=6, single=True)
    assert together.level(TRUE).brightness.mean() > 0.9
    assert alone.level(TRUE).brightness.mean() < 0.9
