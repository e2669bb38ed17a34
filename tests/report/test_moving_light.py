"""The report draws each photo under the light that it was taken in."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gsbake.report.compose import photo_shader
from gsbake.report.lights import LitShader
from gsbake.report.render import Samples, unlit
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import LightMotion


def samples(turn: np.ndarray) -> Samples:
    """Points of a rough ball, seen along their normals, turned."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(200, 3))
    normal = np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True) @ turn.T, np.float32)
    grey, one = np.full((200, 3), 0.5, np.float32), np.ones(200, np.float32)
    return Samples(normal, normal, normal, grey, one, 0.9 * one, 0 * one)


def test_each_photo_has_its_light() -> None:
    light = EnvironmentLight.from_function(lambda d: (1 + d[..., :1].clip(0)) * np.ones(3), 16)
    to_light, *turns = (r.as_matrix() for r in Rotation.random(4, rng=1))
    rotations = np.stack([np.eye(3), *turns])
    shader = photo_shader(LitShader(light, to_light), LightMotion("camera", rotations))
    for index, rotation in enumerate(rotations):
        expected = LitShader(light)(samples(rotation @ to_light))
        assert np.allclose(shader(index)(samples(np.eye(3))), expected, atol=1e-5)
    assert not np.allclose(shader(0)(samples(np.eye(3))), shader(1)(samples(np.eye(3))), atol=0.01)


def test_a_light_that_stands_and_none() -> None:
    learnt = LitShader(EnvironmentLight(16), np.eye(3))
    assert photo_shader(learnt, LightMotion())(3) is learnt
    assert photo_shader(None, LightMotion())(0) is unlit
