"""Pose formats against values computed by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.colmap import pycolmap
from gsbake.capture.photos.decode import apply_orientation
from gsbake.capture.poses.frames import PhotoIndex, PhotoSize, fit_to_photo, rotate_upright
from gsbake.capture.poses.given import read_poses
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera, CameraSet, Similarity

SIZES = {"a.jpg": PhotoSize(200, 100), "b.jpg": PhotoSize(200, 100)}


def write_transforms(path: Path, matrix: Any, **extra: Any) -> Path:
    frames = [{"file_path": "./images/a.jpg", "transform_matrix": matrix}]
    path.write_text(json.dumps({"fl_x": 150.0, "w": 200, "h": 100, "frames": frames} | extra))
    return path


def looking_along_minus_x() -> np.ndarray[Any, Any]:
    """OpenGL camera-to-world: camera at (5, 0, 1), looking along −x, z up; its axes right = +y, up = +z, back = +x."""
    return np.array([[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]], float)


def test_transforms_by_hand(tmp_path: Path) -> None:
    path = write_transforms(tmp_path / "transforms.json", looking_along_minus_x().tolist(), k1=0.1, p2=0.01, cx=90, cy=60)
    given = read_poses(path, ["a.jpg", "b.jpg"], SIZES)
    assert list(given.cameras) == ["a.jpg"] and given.missing == ()
    camera = given.cameras["a.jpg"]
    assert camera.centre == pytest.approx([5, 0, 1]) and camera.view_direction == pytest.approx([-1, 0, 0])
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (150, 150, 90, 60, (0.1, 0.0, 0.0, 0.01))
    # A point 5 before the camera, 1 to its right (+y) and 1 above: right of and above the principal point by 30 px.
    pixel, depth = camera.project(np.array([[0.0, 1.0, 2.0]]))
    assert pixel[0] == pytest.approx([120, 30]) and depth == pytest.approx([5])


def test_transforms_angle_suffixless_and_frame_wins(tmp_path: Path) -> None:
    frames = [
        {"file_path": "./train/a", "transform_matrix": looking_along_minus_x().tolist()},
        {"file_path": "./train/b", "transform_matrix": looking_along_minus_x().tolist(), "camera_angle_x": math.pi / 2},
        {"file_path": "./train/c", "transform_matrix": looking_along_minus_x().tolist()},
    ]
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps({"camera_angle_x": 2 * math.atan(0.5), "frames": frames}))
    given = read_poses(path, [], SIZES)
    assert given.missing == ("./train/c",)
    assert [given.cameras[n].fx for n in ("a.jpg", "b.jpg")] == pytest.approx([200, 100])
    assert (given.cameras["a.jpg"].cx, given.cameras["a.jpg"].cy) == (100, 50)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"at": (0, 3), "value": float("nan")}, r"Frame 1: .*finite number"),
        ({"at": (1, 1), "value": float("inf")}, r"Frame 1: .*finite number"),
        ({"scale": (1.0, 1.0, 2.0)}, r"images/a\.jpg.*no rigid"),
        ({"mirror": True}, r"images/a\.jpg.*no rigid"),
        ({"at": (3, 3), "value": 2.0}, r"images/a\.jpg.*last row"),
    ],
)
def test_invalid_matrices(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    matrix = looking_along_minus_x()
    if "at" in change:
        matrix[change["at"]] = change["value"]
    if "scale" in change:
        matrix[:3, :3] *= change["scale"]
    if "mirror" in change:
        matrix[:3, 0] *= -1
    with pytest.raises(BadInputError, match=words):
        read_poses(write_transforms(tmp_path / "t.json", matrix.tolist()), [], SIZES)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "not a perspective"),
        ({"k4": 0.1}, "k4"),
        ({"fl_x": None}, "no focal length"),
        ({"fl_x": -3.0}, "fl_x: input should be greater than 0"),
        ({"w": 100, "h": 200}, "100x200.*200x100"),
    ],
)
def test_invalid_intrinsics(tmp_path: Path, extra: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        read_poses(write_transforms(tmp_path / "t.json", looking_along_minus_x().tolist(), **extra), [], SIZES)


def test_not_a_transforms_file(tmp_path: Path) -> None:
    for text in ("{", "[]", '{"frames": [{"x": 1}]}', '{"frames": [{"file_path": "a.jpg", "transform_matrix": "no"}]}'):
        (tmp_path / "t.json").write_text(text)
        with pytest.raises(BadInputError):
            read_poses(tmp_path / "t.json", [], SIZES)
    with pytest.raises(BadInputError, match="No frame"):
        read_poses(write_transforms(tmp_path / "t.json", np.eye(4).tolist()), [], {"z.jpg": PhotoSize(200, 100)})


def test_llff_by_hand(tmp_path: Path) -> None:
    # The same camera: down = −z, right = +y, back = +x, at (5, 0, 1); calibrated at twice the photo's size.
    matrix = np.array([[0, 0, 1, 5, 200], [0, 1, 0, 0, 400], [-1, 0, 0, 1, 300]], float)
    rows = np.stack([np.concatenate([matrix.ravel(), [1.0, 9.0]])] * 3)
    rows[0, 3] = 7.0
    np.save(tmp_path / "poses_bounds.npy", rows)
    given = read_poses(tmp_path / "poses_bounds.npy", ["0.jpg", "a.jpg", "b.jpg"], SIZES)  # 0.jpg could not be read
    camera = given.cameras["a.jpg"]
    assert camera.centre == pytest.approx([5, 0, 1]) and camera.view_direction == pytest.approx([-1, 0, 0])
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (200, 100, 150, 100, 50)
    assert camera.project(np.array([[0.0, 1.0, 2.0]]))[0][0] == pytest.approx([130, 20])
    with pytest.raises(BadInputError, match="3 poses but there are 2 photos"):
        read_poses(tmp_path / "poses_bounds.npy", ["a.jpg", "b.jpg"], SIZES)
    rows[1, 7] = np.nan
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(BadInputError, match=r"frame a\.jpg.*NaN"):
        read_poses(tmp_path / "poses_bounds.npy", ["0.jpg", "a.jpg", "b.jpg"], SIZES)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 4)))
    with pytest.raises(BadInputError, match="17 numbers"):
        read_poses(tmp_path / "poses_bounds.npy", ["0.jpg", "a.jpg", "b.jpg"], SIZES)


def test_llff_of_python_2(tmp_path: Path) -> None:
    """NumPy warns of headers with long integers, which is of no use to anybody here."""
    path, rows = tmp_path / "poses_bounds.npy", np.zeros((1, 17))
    rows[0, :15] = np.array([[0, 0, 1, 5, 100], [0, 1, 0, 0, 200], [-1, 0, 0, 1, 150]], float).ravel()
    np.save(path, rows)
    path.write_bytes(path.read_bytes().replace(b"(1, 17), }  ", b"(1L, 17L), }"))
    assert read_poses(path, ["a.jpg"], SIZES).cameras["a.jpg"].centre == pytest.approx([5, 0, 1])


def colmap_text(folder: Path, tx: str = "0") -> Path:
    """A text model with one camera that looks along −x from (5, 0, 1): world→camera rows are right +y, down −z, forward −x."""
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text("1 OPENCV 200 100 150 160 90 60 0.1 0.02 0.003 0.004\n")
    rotation = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], float)
    t = -rotation @ (5, 0, 1)
    # Quaternion of that rotation: trace 0, axis from the antisymmetric part (−1, 1, −1)/(4 w) with w = ½.
    quaternion = (0.5, (0 - -1) / 2, (0 - -1) / 2, (0 - 1) / 2)
    pose = " ".join(str(v) for v in (*quaternion, *t))
    pose = pose if tx == "0" else " ".join([*pose.split()[:4], tx, *pose.split()[5:]])
    (folder / "images.txt").write_text(f"1 {pose} 1 left/a.jpg\n90.0 60.0 1\n")
    (folder / "points3D.txt").write_text("1 0.0 0.0 1.0 10 20 30 0.5 1 0\n")
    return folder


def test_colmap_text_and_binary(tmp_path: Path) -> None:
    text = colmap_text(tmp_path / "text")
    binary = tmp_path / "binary"
    binary.mkdir()
    pycolmap.Reconstruction(str(text)).write_binary(str(binary))
    for folder in (text, binary):
        given = read_poses(folder, [], SIZES)
        camera = given.cameras["a.jpg"]
        assert camera.centre == pytest.approx([5, 0, 1]) and camera.view_direction == pytest.approx([-1, 0, 0])
        assert (camera.fx, camera.fy, camera.distortion) == (150, 160, (0.1, 0.02, 0.003, 0.004))
        assert given.points is not None and given.points.tolist() == [[0, 0, 1]]
        assert given.colours is not None and given.colours.tolist() == [[10, 20, 30]]


def test_broken_colmap_models(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"left/a\.jpg.*NaN|cannot be read"):
        read_poses(colmap_text(tmp_path / "nan", "nan"), [], SIZES)
    folder = colmap_text(tmp_path / "fish")
    (folder / "cameras.txt").write_text("1 OPENCV_FISHEYE 200 100 150 160 90 60 0 0 0 0\n")
    with pytest.raises(BadInputError, match="OPENCV_FISHEYE.*undistort"):
        read_poses(folder, [], SIZES)
    (folder / "images.txt").unlink()
    (folder / "points3D.txt").unlink()
    with pytest.raises(BadInputError, match=r"cannot be read \(it lacks images\.txt, points3D\.txt\)"):
        read_poses(folder, [], SIZES)


def test_colmap_names_with_spaces(tmp_path: Path) -> None:
    """A name is the rest of its line; the line of points may be empty, and lines may end as on Windows."""
    folder = colmap_text(tmp_path / "text")
    one, points = (folder / "images.txt").read_text().splitlines()
    first, second = (one.replace("left/a.jpg", f"left side/{name}.jpg") for name in ("a  1", "b 2"))
    lines = ["# Image list", "", first, points, f"2{second[1:]}", "", ""]
    (folder / "images.txt").write_bytes("\r\n".join(lines).encode())
    sizes = {"left side/a  1.jpg": SIZES["a.jpg"], "left side/b 2.jpg": SIZES["b.jpg"]}
    given = read_poses(folder, [], sizes)
    assert sorted(given.cameras) == sorted(sizes) and given.missing == ()
    assert given.cameras["left side/a  1.jpg"].centre == pytest.approx([5, 0, 1])


def rig_model(folder: Path, second: str) -> Path:
    """A text model of COLMAP 4: a rig of two cameras, the second as `second` says, seen once from the origin moved back by 5."""
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 200 100 150 160 90 60\n2 PINHOLE 200 100 150 160 90 60\n")
    (folder / "rigs.txt").write_text(f"1 2 CAMERA 1 CAMERA 2 {second}\n")
    (folder / "frames.txt").write_text("1 1 1 0 0 0 0 0 5 2 CAMERA 1 1 CAMERA 2 2\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 5 1 a.jpg\n\n2 1 0 0 0 1 0 5 2 b.jpg\n\n")
    (folder / "points3D.txt").write_text("")
    return folder


def test_colmap_rigs_and_frames(tmp_path: Path) -> None:
    """Cameras of a rig are placed by it; a rig of one camera is what COLMAP 4 writes for each single camera."""
    text, binary = rig_model(tmp_path / "text", "1 1 0 0 0 1 0 0"), tmp_path / "binary"
    single = colmap_text(tmp_path / "single")
    pycolmap.Reconstruction(str(single)).write_text(str(single))
    assert (single / "rigs.txt").is_file() and (single / "frames.txt").is_file()
    assert read_poses(single, [], SIZES).cameras["a.jpg"].centre == pytest.approx([5, 0, 1])
    binary.mkdir()
    pycolmap.Reconstruction(str(text)).write_binary(str(binary))
    for folder in (text, binary):
        cameras = read_poses(folder, [], SIZES).cameras
        assert cameras["a.jpg"].centre == pytest.approx([0, 0, -5]) and cameras["b.jpg"].centre == pytest.approx([-1, 0, -5])
    with pytest.raises(BadInputError, match=r"rigs in which cameras have no known place \(b\.jpg\)"):
        read_poses(rig_model(tmp_path / "unknown", "0"), [], SIZES)


def test_frames_match_their_photos() -> None:
    photos = ["left/0.jpg", "right/0.jpg", "1.jpg"]
    assert PhotoIndex(photos).match("images/right/0.jpg") == "right/0.jpg"
    assert PhotoIndex(photos).match("C:\\shots\\1.png") == "1.jpg"
    assert PhotoIndex(photos).match("2.jpg") is None
    with pytest.raises(BadInputError, match="matches several"):
        PhotoIndex(photos).match("0.jpg")


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_camera_rotates_with_its_photo(orientation: int) -> None:
    """A camera of the stored photo, rotated upright, projects each point to its pixel in the upright photo."""
    turn = cv2.Rodrigues(np.array([0.2, -0.3, 0.4]))[0]
    lens = (0.1, -0.05, 0.01, -0.02, 0.03)
    stored = Camera("a", 60, 40, 50.0, 55.0, 28.0, 21.0, np.asarray(turn, float), np.array([0.1, 0.2, 4.0]), lens)
    point = np.array([[0.3, -0.2, 0.5]])

    def pixel(camera: Camera) -> np.ndarray[Any, Any]:
        k = np.asarray(camera.distortion)
        return np.asarray(cv2.projectPoints(point, cv2.Rodrigues(camera.R)[0], camera.t, camera.K, k)[0]).ravel()

    raised = rotate_upright(stored, orientation)
    x, y = pixel(stored)
    columns, rows = np.meshgrid(np.arange(60) + 0.5, np.arange(40) + 0.5)
    near = np.hypot(apply_orientation(columns, orientation) - x, apply_orientation(rows, orientation) - y)  # the stored pixel
    row, column = np.unravel_index(near.argmin(), near.shape)
    assert (raised.width, raised.height) == near.shape[::-1]
    assert pixel(raised) == pytest.approx([column + 0.5, row + 0.5], abs=0.51)
    assert raised.centre == pytest.approx(stored.centre)


def test_camera_of_the_stored_photo_is_recognised() -> None:
    camera = Camera("a", 60, 40, 50, 50, 30, 20, np.eye(3), np.zeros(3))
    assert fit_to_photo(camera, PhotoSize(80, 120, 6), "x").fx == 100
    with pytest.raises(BadInputError):
        fit_to_photo(camera, PhotoSize(80, 120, 1), "x")


def test_camera_set_round_trip_and_moves(tmp_path: Path) -> None:
    turn = np.asarray(cv2.Rodrigues(np.array([0.1, 0.7, -0.3]))[0], float)
    camera = Camera("a", 200, 100, 150.0, 151.0, 99.0, 52.0, turn, np.array([0.1, -0.2, 5.0]), (0.1, 0.0, 0.0, 0.0))
    frame = Similarity(2.5, np.asarray(cv2.Rodrigues(np.array([0.3, 0.0, 0.2]))[0], float), np.array([1.0, 2.0, 3.0]))
    CameraSet((camera,), frame, "solved", True, 0.25).save(tmp_path / "c.json")
    back = CameraSet.load(tmp_path / "c.json")
    assert back.poses == "solved" and back.metric and back.epipolar_px == 0.25 and back.cameras[0].distortion == camera.distortion
    assert np.allclose(back.cameras[0].R, camera.R) and back.to_world.matrix() == pytest.approx(frame.matrix())
    points = np.random.default_rng(0).normal(size=(5, 3))
    here, depth = camera.project(points)
    there, far = camera.moved(frame).project(frame.apply(points))
    assert there == pytest.approx(here) and far == pytest.approx(2.5 * depth)
    assert frame.inverse().apply(frame.apply(points)) == pytest.approx(points)
    assert frame.then(frame.inverse()).matrix() == pytest.approx(np.eye(4))
    R, t = Camera.pose_from_opengl(camera.camera_to_world_opengl())
    assert pytest.approx(camera.R) == R and t == pytest.approx(camera.t)
