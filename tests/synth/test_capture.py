"""The built-in capture: poses, camera convention, ground truth that agrees with the photos, determinism."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from gsbake.errors import UsageError
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.imaging.srgb import encode_bytes
from gsbake.scale.markers import find_markers
from gsbake.synth import scene
from gsbake.synth.capture import cameras, look_at, true_mesh, write_capture
from gsbake.synth.shade import render, studio_rig

VIEWS, SIZE = 6, 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "capture"
    write_capture(out, views=VIEWS, size=SIZE)
    return out


def rgba(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture[..., [2, 1, 0, 3]]


def nerf_project(frame: dict, top: dict, point: np.ndarray) -> np.ndarray:
    """Pixel of a world point by the definition of transforms.json: OpenGL axes, looking along -z, y up."""
    x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ [*point, 1]
    assert z < 0
    return np.array([top["cx"] + top["fl_x"] * x / -z, top["cy"] - top["fl_y"] * y / -z])


def test_files(folder: Path) -> None:
    names = {f"{i:03d}.png" for i in range(VIEWS)}
    assert {p.name for p in (folder / "images").iterdir()} == names
    for kind in ("masks", "albedo", "normal", "orm"):
        assert {p.name for p in (folder / "truth" / kind).iterdir()} == names
    picture = rgba(folder / "images" / "000.png")
    assert picture.shape == (SIZE, SIZE, 4)
    coverage = picture[..., 3] / 255
    assert 0.15 < coverage.mean() < 0.6
    assert np.any((coverage > 0) & (coverage < 1))  # supersampled edges
    border = np.concatenate([coverage[0], coverage[-1], coverage[:, 0], coverage[:, -1]])
    assert border.max() == 0  # nothing is cut off


def test_poses_place_a_known_point(folder: Path) -> None:
    top = json.loads((folder / "transforms.json").read_text())
    assert (top["w"], top["h"]) == (SIZE, SIZE) and len(top["frames"]) == VIEWS
    truth = CameraSet.load(folder / "truth" / "cameras.json").cameras
    point = np.array([scene.ORIGIN[0] + 0.62, scene.ORIGIN[1], 0.52])
    metallic = []
    for frame, camera in zip(top["frames"], truth, strict=True):
        pixel = nerf_project(frame, top, point)
        np.testing.assert_allclose(camera.project(point[None])[0][0], pixel, atol=1e-9)
        picture = rgba(folder / frame["file_path"])
        x, y = pixel.astype(int)
        assert picture[y, x, 3] > 0  # the handle (or the jar before it) covers its own projection
        maps = rgba(folder / "truth" / "orm" / Path(frame["file_path"]).name)
        metallic.append(maps[y, x, 2] > 200)
    assert any(metallic)  # metallic where it is not occluded


def test_silhouette_agrees_with_the_mesh(folder: Path) -> None:
    mesh = trimesh.load(folder / "truth" / "mesh.ply", process=False)
    for camera in CameraSet.load(folder / "truth" / "cameras.json").cameras[:3]:
        pixels, depth = camera.project(np.asarray(mesh.vertices))
        assert depth.min() > 0
        mask = cv2.imread(str(folder / "truth" / "masks" / f"{camera.name}.png"), cv2.IMREAD_GRAYSCALE)
        at = pixels.astype(int)
        grown = cv2.dilate(mask, np.ones((3, 3), np.uint8))  # a silhouette may miss all four samples of its pixel
        assert np.all(grown[at[:, 1], at[:, 0]] > 0)
        ys, xs = np.nonzero(mask)
        np.testing.assert_allclose([xs.min(), ys.min()], np.floor(pixels.min(axis=0)), atol=1)
        np.testing.assert_allclose([xs.max(), ys.max()], np.floor(pixels.max(axis=0)), atol=1)


def test_true_mesh_lies_on_the_surface_and_faces_out() -> None:
    vertices, faces = true_mesh(cells=64)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert np.abs(scene.distances(vertices)).max() < 2e-3
    assert np.median(np.abs(scene.distances(vertices))) < 1e-9
    assert mesh.is_watertight and mesh.volume > 0
    assert mesh.euler_number == 0  # one handle: a torus
    aligned = np.sum(mesh.face_normals * scene.normals(mesh.triangles_center), axis=1)
    assert np.median(aligned) > 0.98


def test_points_carry_true_materials(folder: Path) -> None:
    with np.load(folder / "truth" / "points.npz") as truth:
        points = truth["position"].astype(float)
        metallic, albedo, normal = truth["metallic"], truth["albedo"], truth["normal"].astype(float)
    assert len(points) == 30_000
    assert np.abs(scene.distances(points)).max() < 2e-3
    ahead = scene.distances(points + 0.005 * normal)
    assert np.mean(np.abs(ahead - 0.005) < 5e-4) > 0.97  # normals point out
    np.testing.assert_allclose(albedo, scene.materials(points)[:, :3], atol=2e-3)
    assert 0.1 < metallic.mean() < 0.4
    # Uniform by area: the underside's disc (radius .27 plus half its rounding) holds its share of the points.
    mesh = trimesh.load(folder / "truth" / "mesh.ply", process=False)
    below = points[:, 2] < 1e-3
    assert abs(below.mean() - np.pi * 0.27**2 / mesh.area) < 0.01


def test_albedo_maps_match_the_points(folder: Path) -> None:
    camera = CameraSet.load(folder / "truth" / "cameras.json").cameras[1]
    with np.load(folder / "truth" / "points.npz") as truth:
        points, albedo, normal = truth["position"].astype(float), truth["albedo"].astype(float), truth["normal"]
    pixels, depth = camera.project(points)
    towards = np.sum(normal * (camera.centre - points), axis=1) / np.linalg.norm(camera.centre - points, axis=1)
    tree = cKDTree(pixels)
    front = np.array([depth[i] < depth[tree.query_ball_point(pixels[i], 1.5)].min() + 0.05 for i in range(0, len(points), 15)])
    use = np.arange(0, len(points), 15)[front & (towards[::15] > 0.5)]
    at = pixels[use].astype(int)
    shown = rgba(folder / "truth" / "albedo" / f"{camera.name}.png")[at[:, 1], at[:, 0], :3].astype(float)
    expected = encode_bytes(albedo[use]).astype(float)
    assert np.median(np.abs(shown - expected)) < 12
    assert np.corrcoef(shown.ravel(), expected.ravel())[0, 1] > 0.75


def test_cameras_look_at_the_object_with_the_world_up() -> None:
    for camera in cameras(24, 128, 3):
        np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.R) > 0
        above = camera.project(np.array(scene.CENTRE) + [[0, 0, 0.0], [0, 0, 0.1]])[0]
        assert np.linalg.norm(above[0] - [camera.cx, camera.cy]) < 6
        assert above[1, 1] < above[0, 1]  # up in the world is up in the picture
    heights = [c.centre[2] for c in cameras(24, 128, 3)]
    assert min(heights) < -0.3 and max(heights) > 2


def test_same_arguments_same_bytes_and_the_seed_counts(folder: Path, tmp_path: Path) -> None:
    write_capture(tmp_path / "again", views=VIEWS, size=SIZE)
    write_capture(tmp_path / "other", views=3, size=16, seed=1, poses=False)
    for file in ("images/003.png", "transforms.json", "truth/points.npz", "truth/mesh.ply"):
        assert (tmp_path / "again" / file).read_bytes() == (folder / file).read_bytes()
    assert not (tmp_path / "other" / "transforms.json").exists()
    first: Camera = cameras(3, 16, 0)[0]
    assert np.linalg.norm(first.centre - cameras(3, 16, 1)[0].centre) > 0.1


def test_background_fills_the_image(tmp_path: Path) -> None:
    write_capture(tmp_path, views=3, size=32, background=True)
    picture = cv2.imread(str(tmp_path / "images" / "000.png"), cv2.IMREAD_UNCHANGED)
    mask = cv2.imread(str(tmp_path / "truth" / "masks" / "000.png"), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (32, 32, 3) and picture.min() > 0
    assert 0 < np.mean(mask > 0) < 1
    assert not (tmp_path / "masks").exists()


def test_srgb_code_values() -> None:
    # 0.18 (grey card) codes to 118, 0.5 to 188, the linear toe is 12.92 x.
    np.testing.assert_array_equal(encode_bytes(np.array([0.0, 0.002, 0.18, 0.5, 1.0, 2.0])), [0, 7, 118, 188, 255, 255])


@pytest.mark.parametrize(("views", "size"), [(2, 128), (24, 8)])
def test_too_small_is_a_usage_error(tmp_path: Path, views: int, size: int) -> None:
    with pytest.raises(UsageError, match="built-in capture"):
        write_capture(tmp_path, views=views, size=size)


@pytest.mark.slow
def test_the_printed_marker_is_read_and_has_its_size(tmp_path: Path) -> None:
    rig, cells = studio_rig(), scene.marker_cells()
    target = np.array([*scene.MARKER_CENTRE, 0.0])
    cams = [look_at(str(k), target + (0.5 * k - 0.5, 0.7, 0.8), target, 0.1 * k, 256, (128, 128), 256) for k in range(3)]
    for camera in cams:
        image, _ = render(camera.R, camera.centre, camera.fx, camera.fy, camera.cx, camera.cy, 256, 256, rig, True, cells)
        assert cv2.imwrite(str(tmp_path / f"{camera.name}.png"), encode_bytes(image[..., 2::-1]))
    dictionary, (marker,) = find_markers(cams, tmp_path)
    assert (dictionary, marker.number) == ("aruco-4x4", scene.MARKER_NUMBER)
    assert abs(marker.sides.mean() / scene.MARKER_SIZE - 1) < 0.01
    assert np.abs(marker.corners.mean(0) - target).max() < 0.002


def test_a_marker_lies_on_a_ground(tmp_path: Path) -> None:
    write_capture(tmp_path, views=3, size=32, marker=True)
    assert cv2.imread(str(tmp_path / "images" / "000.png"), cv2.IMREAD_UNCHANGED).shape == (32, 32, 3)
