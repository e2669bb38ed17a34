"""The material fit where the light moves with the turntable or the camera."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gsbake.config.schema import Bake
from gsbake.imaging.srgb import encode
from gsbake.materials.fitting import FitSettings, _Fitting
from gsbake.materials.levels import FitLevel
from gsbake.materials.options import FitSchedule
from gsbake.materials.pixels import Pixels
from gsbake.materials.two_level_fit import FitPlan, compare_light_motions
from gsbake.shading.light_motion import Motion, light_rotations
from tests.materials.test_fit import WEAK_PRIORS, Scene, cameras, room
from tests.support.cameras import look_at
from tests.support.recorder import Recorder
from tests.support.slow import slow

COUNT = 12


@pytest.fixture(scope="module", params=["turntable", slow("camera")])
def moving(request: pytest.FixtureRequest) -> tuple[Motion, Scene]:
    return request.param, Scene(0.25, COUNT, motion=request.param)


def under(scene: Scene, motion: Motion) -> list[Pixels]:
    """The photos, explained by a light that moves so."""
    rotations = light_rotations(cameras(COUNT), motion)
    return scene.photos if rotations is None else [replace(p, to_light=r) for p, r in zip(scene.photos, rotations, strict=True)]


def test_materials_are_recovered_under_a_moving_light(moving: tuple[Motion, Scene]) -> None:
    motion, scene = moving
    photos = under(scene, motion)
    fitted = scene.fit(0.2).run(photos[2:], photos[:2], FitSchedule(300))
    known = fitted.weight > 0.3
    base_color, truth = fitted.values[known, :3], scene.base_color[known]
    gain = (base_color * truth).sum(0) / (base_color**2).sum(0)
    assert np.abs(encode(base_color * gain) - encode(truth)).mean() < 0.06
    assert np.abs(fitted.values[known, 3] - 0.25).mean() < 0.1
    still = scene.fit(0.2).run(scene.photos[2:], scene.photos[:2], FitSchedule(300))
    assert fitted.held_out_psnr is not None and still.held_out_psnr is not None
    assert fitted.held_out_psnr > still.held_out_psnr + 3
    # The light as the first photo sees it.
    direction = np.array([[0.8, 0.0, 0.6], [-0.8, 0.0, -0.6]])
    from gsbake.shading.cubemap import sample

    bright, dark = sample(fitted.light.radiance().detach().numpy(), direction).mean(1)
    assert bright > 4 * dark and room(direction)[0, 0] > 4 * room(direction)[1, 0]


def test_how_the_light_moves_is_found(moving: tuple[Motion, Scene]) -> None:
    motion, scene = moving
    assert best_motion(scene) == motion


def test_a_light_that_stands_is_found() -> None:
    assert best_motion(Scene(0.25, COUNT)) == "static"


def test_a_turn_that_is_asked_for_and_not_there_is_said() -> None:
    """Cameras rolled at random have no common axis: the light stands, and the report does not say otherwise."""
    recorder = Recorder()
    rolled = [look_at(np.random.default_rng(k).normal(size=3) * 3, roll=2.3 * k) for k in range(9)]
    fitting = SimpleNamespace(settings=FitSettings(Bake(light_motion="turntable")), cameras=rolled, monitor=recorder)
    pixels = SimpleNamespace(under=lambda rotations: rotations)
    assert _Fitting._under_moving_light(fitting, None, pixels, False) is None  # type: ignore[arg-type]
    assert fitting.light_motion.motion == "static"
    assert any("do not turn about one axis" in text for text in recorder.warnings)


def best_motion(scene: Scene) -> Motion:
    motions: tuple[Motion, ...] = ("static", "turntable", "camera")
    levels = {m: FitLevel(scene.surface(), photos[2:], photos[:2]) for m in motions for photos in [under(scene, m)]}
    found = compare_light_motions(levels, FitPlan(400, 16, WEAK_PRIORS), lambda *_: None)
    return min(found, key=lambda motion: found[motion])
