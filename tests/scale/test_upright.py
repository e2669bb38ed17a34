"""The up axis by markers and by the ground, where the cameras' is wrong, and what gives none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsbake.config.schema import Export, Scale
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, CameraSet, Similarity
from gsbake.scale.markers import Marker
from gsbake.scale.upright import front_rotation, marker_axis, measure_rotation, points_axis
from gsbake.surfels.initialisation import fibonacci_sphere
from gsbake.surfels.model import Surfels, create
from tests.scale.test_markers import photograph, ring
from tests.support.recorder import Recorder

TILT = Rotation.from_euler("xy", [12, -7], degrees=True).as_matrix()
SQUARE = np.array([(-1, 1, 0), (1, 1, 0), (1, -1, 0), (-1, -1, 0)]) * 0.05


def marker(rotation: Array, at: tuple[float, float, float] = (0, 0, 0), number: int = 0) -> Marker:
    return Marker(number, SQUARE @ rotation.T + at, np.full(4, 0.1), 5)


def posed(folder: Path, masks: bool = False) -> Any:
    return SimpleNamespace(folder=folder, has_masks=masks, cameras=CameraSet(tuple(ring()), Similarity(2.0, TILT), "solved"))


def test_the_normal_of_one_marker_and_of_many() -> None:
    assert np.allclose(marker_axis([marker(TILT)])[0], TILT[:, 2])
    shaken = [Rotation.from_euler("xy", angles, degrees=True).as_matrix() @ TILT for angles in ((3, 1), (-2, 4), (1, -5))]
    spread = [marker(r, tuple(TILT @ at), k) for k, (r, at) in enumerate(zip(shaken, ((1, 0, 0), (-1, 1, 0), (0, -1, 0)), strict=True))]
    axis, evidence = marker_axis(spread)
    assert axis is not None and "3 markers" in evidence
    # their centres tell the plane better than their own normals
    assert np.degrees(np.arccos(axis @ TILT[:, 2])) < 0.5


def test_markers_that_have_no_common_plane() -> None:
    wall = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    axis, evidence = marker_axis([marker(TILT), marker(wall)])
    assert axis is None and "do not lie on one plane" in evidence
    assert marker_axis([])[0] is None


def test_markers_in_photos_level_the_world(tmp_path: Path) -> None:
    cameras = ring()
    for number, at in enumerate(((-0.6, 0.1), (0.4, -0.3))):
        photograph(tmp_path / "photos", cameras, "aruco-5x5", number, at)
    CameraSet(tuple(c.moved(Similarity(1.0, TILT)) for c in cameras)).save(tmp_path / "photo_cameras.json")
    monitor = Recorder()
    rotation = measure_rotation(tmp_path, posed(tmp_path), tmp_path, Export(up="markers"), Scale(), monitor=monitor)
    assert np.degrees(np.arccos((rotation @ TILT[:, 2])[2])) < 0.2
    assert monitor.decisions["up axis"][0] == f"markers, {np.degrees(np.arccos(TILT[2, 2])):.1f}° off that of the cameras"
    assert np.array_equal(measure_rotation(tmp_path, posed(tmp_path), tmp_path, Export(), Scale()), np.eye(3))


@pytest.mark.parametrize("masks", [False, True])
def test_the_ground_under_an_object(masks: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    disc = np.sqrt(rng.random(4000))[:, None] * np.stack([np.cos(a := rng.uniform(0, 7, 4000)), np.sin(a)], 1)
    ball = 0.2 * fibonacci_sphere(1500)
    points = np.concatenate([np.column_stack([0.98 * disc, np.full(4000, -0.2)]), ball])
    normals = np.concatenate([np.tile([0.0, 0, 1], (4000, 1)), ball / 0.2])
    lean = Rotation.from_euler("x", 5, degrees=True).as_matrix()
    surfels = create(points @ lean.T, normals @ lean.T, np.full(len(points), 0.02), None, "colour", 0, 0.0, 50.0)
    surfels.save(tmp_path / "surfels.safetensors")
    monitor = Recorder()
    rotation = measure_rotation(tmp_path, posed(tmp_path, masks), tmp_path, Export(up="ground"), Scale(), monitor=monitor)
    if masks:
        assert np.array_equal(rotation, np.eye(3)) and "the photos have masks" in monitor.warnings[0]
    else:
        assert np.degrees(np.arccos(np.clip((rotation @ TILT @ lean[:, 2])[2], -1, 1))) < 0.2


def test_without_ground_up_stays_that_of_the_cameras(tmp_path: Path) -> None:
    p = fibonacci_sphere(2000)
    ball: Surfels = create(0.5 * p, p, np.full(len(p), 0.03), None, "colour", 0, 0.0, 50.0)
    replace(ball, sdf=torch.zeros(len(p))).save(tmp_path / "surfels.safetensors")
    monitor = Recorder()
    assert np.array_equal(measure_rotation(tmp_path, posed(tmp_path), tmp_path, Export(up="ground"), Scale(), monitor=monitor), np.eye(3))
    assert "up is that of the cameras" in monitor.warnings[0]


def test_up_by_points() -> None:
    """Three points of the ground give its normal on the cameras' side in either order; an edge gives its own direction."""
    ground, above = np.array([(0.2, 0, 0), (1, 0.1, 0), (0, 1, 0)]) @ TILT.T, np.array([(0, 0, 2.0)]) @ TILT.T
    for order in ([0, 1, 2], [2, 1, 0]):
        axis, evidence = points_axis(ground[order], above)
        assert np.allclose(axis, TILT[:, 2]) and evidence == "three points of the ground"
    assert np.allclose(points_axis(np.array([(1, 1, 3.0), (1, 1, 1)]), above)[0], (0, 0, -1))
    for points in (ground[[0, 0, 1]], np.array([(0, 0, 0), (1, 1, 1), (2, 2, 2.001)]), ground[[1, 1]]):
        with pytest.raises(ValueError, match="coincide or lie on one line"):
            Export(up_points=tuple(points.ravel()))


def test_up_by_points_comes_before_what_is_level(tmp_path: Path) -> None:
    numbers = tuple((np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)]) @ TILT.T).ravel())
    monitor = Recorder()
    rotation = measure_rotation(tmp_path, posed(tmp_path), tmp_path, Export(up="markers", up_points=numbers), Scale(), monitor=monitor)
    assert np.allclose(rotation @ TILT[:, 2], (0, 0, 1)) and monitor.decisions["up axis"][1] == "three points of the ground"


def test_the_front_is_where_a_camera_stands() -> None:
    camera = ring()[2]
    turn = front_rotation(camera, np.array([0.1, 0.2, 0]))
    towards = turn @ (camera.centre - (0.1, 0.2, 0))
    assert abs(towards[0]) < 1e-9 and towards[1] < 0 and np.allclose(turn @ (0, 0, 1), (0, 0, 1)) and np.isclose(np.linalg.det(turn), 1)
    with pytest.raises(BadInputError, match="straight above or below"):
        front_rotation(camera, camera.centre - (0, 0, 1))
