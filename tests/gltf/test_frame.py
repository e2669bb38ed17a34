"""The asset frame, and the cameras in it."""

from __future__ import annotations

import numpy as np

from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from gsbake.gltf.frame import asset_frame, transforms_json


def turn(axis: int, angle: float) -> np.ndarray:
    out = np.eye(3)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    out[a, a] = out[b, b] = np.cos(angle)
    out[b, a], out[a, b] = np.sin(angle), -np.sin(angle)
    return out


FRAME = Similarity(2.5, turn(2, 0.7) @ turn(0, 0.3), np.array([1.0, -2, 3]))
POINTS = np.random.default_rng(0).uniform(-1, 1, (100, 3))
VIEW = Camera("shot", 640, 480, 500, 510, 320, 240, turn(1, 0.4) @ turn(0, 2.0), np.array([0.1, 0.2, 3]))


def test_given_poses_keep_the_origin_of_the_world() -> None:
    frame = asset_frame(CameraSet((VIEW,), FRAME, "given"), POINTS)
    world = FRAME.apply(POINTS)
    assert np.allclose(frame.apply(POINTS), np.stack([world[:, 0], world[:, 2], -world[:, 1]], 1))
    assert np.isclose(np.linalg.det(frame.rotation), 1)


def test_solved_poses_have_their_origin_below_the_object() -> None:
    placed = asset_frame(CameraSet((VIEW,), FRAME, "solved"), POINTS).apply(POINTS)
    assert np.isclose(placed[:, 1].min(), 0)
    assert np.allclose((placed.min(0) + placed.max(0))[[0, 2]], 0)
    assert np.allclose(np.ptp(placed, axis=0), np.ptp(FRAME.apply(POINTS)[:, [0, 2, 1]], axis=0))


def test_the_origin_that_the_settings_name() -> None:
    for poses in ("given", "solved"):
        cameras = CameraSet((VIEW,), FRAME, poses)
        bottom, centre = (asset_frame(cameras, POINTS, origin).apply(POINTS) for origin in ("bottom", "centre"))  # type: ignore[arg-type]
        middle = (bottom.min(0) + bottom.max(0)) / 2
        assert np.isclose(bottom[:, 1].min(), 0) and np.allclose(middle[[0, 2]], 0)
        assert np.allclose((centre.min(0) + centre.max(0)) / 2, 0)


def test_exported_cameras_project_the_asset_to_the_photos_pixels() -> None:
    cameras = CameraSet((VIEW,), FRAME, "solved")
    frame = asset_frame(cameras, POINTS)
    body = transforms_json(cameras, frame, {"shot": "IMG_1.JPG"})
    (entry,) = body["frames"]
    assert entry["file_path"] == "IMG_1.JPG" and body["scale"] == "unknown"
    to_camera = np.linalg.inv(np.array(entry["transform_matrix"]))
    local = frame.apply(POINTS) @ to_camera[:3, :3].T + to_camera[:3, 3]
    # OpenGL camera: looks along -z, y up.
    x = entry["fl_x"] * local[:, 0] / -local[:, 2] + entry["cx"]
    y = entry["fl_y"] * -local[:, 1] / -local[:, 2] + entry["cy"]
    assert np.allclose(np.stack([x, y], 1), VIEW.project(POINTS)[0], atol=1e-6)
