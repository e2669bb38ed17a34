"""Error measures on shapes with known distances."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

import benchmarks.truth
from benchmarks.truth import (
    Surface,
    Truth,
    align,
    measure,
    measure_aligned,
    measure_file,
    nearest,
    nearest_on_faces,
    read_centres,
    read_mesh,
    read_truth,
)
from gsbake.errors import UsageError
from gsbake.geometry.cameras import Similarity

AROUND = {str(i): 4.0 * v / np.linalg.norm(v) for i, v in enumerate(np.array(list(np.ndindex(3, 3, 3))) - 1.0) if v.any()}


@pytest.fixture(autouse=True)
def _fewer_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmarks.truth, "SAMPLE_COUNT", 8_000)
    monkeypatch.setattr(benchmarks.truth, "ANCHOR_COUNT", 40_000)
    monkeypatch.setattr(benchmarks.truth, "ALIGNMENT_POINTS", (5_000, 30_000))


def ball(radius: float = 1.0, subdivisions: int = 5) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64))


def spiral() -> Surface:
    """A shape without symmetry: three boxes of different sizes that touch."""
    boxes = [trimesh.creation.box(size) for size in ((2, 1, 0.6), (0.5, 0.4, 1.5), (0.3, 1.4, 0.3))]
    for box, shift in zip(boxes, ((0, 0, 0), (0.7, 0.2, 0.9), (-0.8, 1.0, 0.1)), strict=True):
        box.apply_translation(shift)
    whole = trimesh.util.concatenate(boxes)
    return Surface(np.asarray(whole.vertices, float), np.asarray(whole.faces, np.int64))


@pytest.mark.parametrize(("grown", "fscore"), [(0.01, 1.0), (0.05, 0.0)])
def test_distance_of_concentric_spheres_is_the_difference_of_their_radii(grown: float, fscore: float) -> None:
    found = measure(ball(1 + grown), Truth(ball(), AROUND))
    expected = 100 * grown / (2 * 3**0.5)  # in % of the diagonal of the unit sphere's bounding box
    assert found.chamfer_pct == pytest.approx(expected, rel=0.03)
    assert found.accuracy_pct == pytest.approx(expected, rel=0.03) and found.completeness_pct == pytest.approx(expected, rel=0.03)
    assert found.fscore == fscore
    assert found.normal_deg < 1.5  # adjacent faces of these spheres differ by about 1.8 degrees


def test_only_the_visible_surface_counts_and_missing_parts_lower_completeness() -> None:
    whole = ball(subdivisions=4)
    upper = Surface(whole.vertices, whole.faces[whole.corners[:, :, 2].min(1) > 0])
    above = {k: v for k, v in AROUND.items() if v[2] > 2}
    assert measure(upper, Truth(whole, above)).completeness_pct < 0.5 * measure(upper, Truth(whole, AROUND)).completeness_pct
    found = measure(upper, Truth(whole, AROUND))
    assert found.accuracy_pct < 0.01 < 5 < found.completeness_pct


def test_normal_error_of_a_rotated_face() -> None:
    plate = Surface(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    lean = np.radians(5)
    turned = plate.moved(Similarity(rotation=np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])))
    found = measure(turned, Truth(plate, {"a": np.array([0.0, 0, 4]), "b": np.array([1.0, 0, 4])}))
    assert found.normal_deg == pytest.approx(5, abs=1e-6)
    assert found.accuracy_pct == pytest.approx(100 * np.sin(lean) / 2 / 8**0.5, rel=0.03)  # the mean |y| of the plate is a half


def test_nearest_points_match_an_exhaustive_search() -> None:
    rng = np.random.default_rng(0)
    corners, points = rng.normal(size=(40, 3, 3)), 2 * rng.normal(size=(40, 3))
    step = np.linspace(0, 1, 201)
    u, v = (g[np.add.outer(step, step) <= 1 + 1e-9] for g in np.meshgrid(step, step, indexing="ij"))
    dense = np.einsum("wk,nkc->nwc", np.stack([1 - u - v, u, v], 1), corners)
    expected = np.linalg.norm(dense - points[:, None], axis=2).min(1)
    found = np.linalg.norm(nearest_on_faces(points, corners) - points, axis=1)
    assert (found <= expected + 1e-12).all()
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_nearest_on_a_degenerate_triangle_is_on_its_edge() -> None:
    flat = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]])  # no area
    np.testing.assert_allclose(nearest_on_faces(np.array([[1.5, 1.0, 0]]), flat), [[1.5, 0, 0]])


def test_distances_to_a_box_are_exact() -> None:
    box = trimesh.creation.box((2, 2, 2))
    points = np.array([[0.3, 0.2, 1.25], [2.0, 2.0, 0.0], [1.5, 1.5, 1.5]])
    distance, _ = nearest(points, Surface(np.asarray(box.vertices, float), np.asarray(box.faces, np.int64)), 0)
    np.testing.assert_allclose(distance, [0.25, 2**0.5, 0.75**0.5])


def test_a_mesh_in_another_frame_is_aligned_with_the_ground_truth() -> None:
    shape = spiral()
    rng = np.random.default_rng(2)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    away = Similarity(0.37, rotation, np.array([3.0, -1.0, 2.0]))
    centres = {k: away.apply(v) + 0.003 * rng.normal(size=3) for k, v in AROUND.items()}
    centres["3"] = np.array([50.0, 0, 0])  # an outlier
    truth = Truth(shape, AROUND)
    found = align(shape.moved(away), centres, truth).matrix()
    np.testing.assert_allclose(found, away.inverse().matrix(), atol=0.01)
    assert measure_aligned(shape.moved(away), centres, truth).chamfer_pct < 0.1
    with pytest.raises(UsageError, match=r"takes 3"):
        align(shape, {"0": centres["0"], "x": centres["1"]}, truth)


def test_similarity_has_no_reflection() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(20, 3))
    found = Similarity.between(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_files_are_read_in_the_world_frame(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    (capture / "gt").mkdir(parents=True)
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    whole = spiral()
    glb = trimesh.Trimesh(whole.vertices, whole.faces, process=False).apply_transform(y_up)
    glb.export(capture / "gt" / "asset.glb")
    poses = [np.block([[np.eye(3), v[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist() for v in AROUND.values()]
    (capture / "gt" / "train.json").write_text(json.dumps({"names": [f"{k}.png" for k in AROUND], "c2w": poses}))
    np.testing.assert_allclose(read_mesh(capture / "gt" / "asset.glb").vertices, whole.vertices, atol=1e-6)
    trimesh.Trimesh(whole.vertices, whole.faces, process=False).export(tmp_path / "mesh.ply")
    np.testing.assert_allclose(read_mesh(tmp_path / "mesh.ply").vertices, whole.vertices, atol=1e-6)
    frames = [
        {"file_path": f"images/{k}.jpg", "transform_matrix": (y_up @ np.array(p)).tolist()} for k, p in zip(AROUND, poses, strict=True)
    ]
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": frames}))
    truth = read_truth(capture)
    assert truth.centres.keys() == AROUND.keys()
    for name, centre in read_centres(tmp_path / "cameras.json").items():
        np.testing.assert_allclose(centre, AROUND[name])
    assert measure_file(tmp_path / "mesh.ply", capture).chamfer_pct < 1e-3
    with pytest.raises(UsageError, match="no ground truth"):
        read_truth(tmp_path)
    with pytest.raises(UsageError, match="no mesh"):
        read_mesh(tmp_path / "gone.ply")


def test_an_invisible_mesh_is_an_error() -> None:
    inward = ball(subdivisions=2)
    with pytest.raises(UsageError, match="see nothing"):
        measure(Surface(inward.vertices, inward.faces[:, ::-1]), Truth(ball(subdivisions=2), AROUND))
