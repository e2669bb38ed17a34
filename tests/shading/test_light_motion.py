"""Rotations of a light that moves, and rotated cube maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.shading.cubemap import directions
from gsbake.shading.light_motion import LightMotion, Motion, light_rotations, mean_radiance, rotated
from tests.support.cameras import look_at

#: A table that is tilted in the frame of the object.
TILT = np.array([[1, 0, 0], [0, np.cos(0.7), -np.sin(0.7)], [0, np.sin(0.7), np.cos(0.7)]])
AXIS = TILT @ [0.0, 0.0, 1.0]


def turntable(turns: np.ndarray, roll: float = 0.0) -> list[Camera]:
    """Cameras of photos from two heights, as the object sees them."""
    heights = np.where(np.arange(len(turns)) % 2, 1.0, 2.5)
    return [
        look_at(TILT @ [3 * np.cos(a), 3 * np.sin(a), h], up=AXIS, roll=roll, name=str(k))
        for k, (a, h) in enumerate(zip(turns, heights, strict=True))
    ]


def turned(angle: float) -> np.ndarray:
    """The turn about the table's axis."""
    c, s = np.cos(angle), np.sin(angle)
    return TILT @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ TILT.T


def test_a_turntable_turns_the_light_with_the_cameras() -> None:
    """A lamp that stands in the room is, for the object, at the camera's azimuth plus a constant."""
    turns = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    found = light_rotations(turntable(turns), "turntable")
    assert found is not None
    lamp = np.array([0.3, -0.5, 0.8])
    for k, turn in enumerate(turns):
        assert found[k] @ (turned(turn) @ lamp) == pytest.approx(lamp, abs=1e-9)


def test_a_light_on_the_camera_turns_as_the_camera() -> None:
    cameras = turntable(np.linspace(0, 4, 9))
    found = light_rotations(cameras, "camera")
    assert found is not None
    ahead = [r @ c.view_direction for r, c in zip(found, cameras, strict=True)]
    assert np.allclose(ahead, cameras[0].view_direction)


@pytest.mark.parametrize(
    ("cameras", "motion"),
    [
        (turntable(np.linspace(0, 6, 8)), "static"),
        (turntable(np.linspace(0, 6, 8))[:1], "turntable"),
        (turntable(np.linspace(0, 1.2, 16)), "turntable"),  # too little of a turn to tell
        ([look_at(np.random.default_rng(k).normal(size=3) * 3, roll=2.3 * k) for k in range(9)], "turntable"),
    ],
)
def test_where_there_is_no_turntable_there_is_no_rotation(cameras: list[Camera], motion: Motion) -> None:
    assert light_rotations(cameras, motion) is None


def test_a_rotated_cube_map_is_the_rotated_function() -> None:
    def light(d: np.ndarray) -> np.ndarray:
        return np.stack([1 + d[..., 0], 2 + d[..., 1] * d[..., 2], 1.5 - d[..., 2]], -1)

    turn = turned(0.9)
    around = directions(32)
    cube = torch.from_numpy(light(around).astype(np.float32)).requires_grad_()
    found = rotated(cube, turn)
    assert np.abs(found.detach().numpy() - light(around @ turn.T)).max() < 5e-3
    # The gradient is that of a linear map: its product with the map itself is the sum of the result.
    (gradient,) = torch.autograd.grad(found.sum(), cube)
    assert float((gradient * cube.detach()).sum()) == pytest.approx(float(found.detach().sum()), rel=1e-5)
    assert rotated(cube, None) is cube


def test_the_mean_over_a_whole_turn_is_symmetric() -> None:
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rotations = light_rotations(turntable(turns), "turntable")
    assert rotations is not None
    around = directions(16)
    radiance = (1 + np.maximum(around @ (TILT @ [1.0, 0, 0]), 0))[..., None] * np.ones(3)
    mean = mean_radiance(radiance, list(rotations))
    level = np.abs(around @ AXIS) < 0.1
    assert mean[level].std() < 0.02 < radiance[level].std()
    assert np.array_equal(mean_radiance(radiance, [None, None]), radiance.astype(np.float32))


def test_the_motion_is_saved_and_damaged_files_are_refused(tmp_path: Path) -> None:
    motion = LightMotion("turntable", light_rotations(turntable(np.linspace(0, 6, 12)), "turntable"))
    motion.save(tmp_path / "m.json")
    again = LightMotion.load(tmp_path / "m.json")
    assert again.motion == "turntable" and again.rotations is not None and np.allclose(again.rotations, motion.rotations)
    assert LightMotion.load(tmp_path / "none.json").rotations is None
    (tmp_path / "m.json").write_text('{"motion": "turntable"}')
    with pytest.raises(BadInputError, match="bake again"):
        LightMotion.load(tmp_path / "m.json")
