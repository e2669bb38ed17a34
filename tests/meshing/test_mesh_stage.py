"""Mesh extraction end to end: surfels on a torus are rendered, meshed and compared with the torus."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh

from gsbake.config.schema import Mesh
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, CameraSet
from gsbake.geometry.region import Region
from gsbake.meshing.extract import MeshOptions, extract_mesh
from gsbake.meshing.refinement.shape import evenly
from gsbake.surfels.model import create
from tests.meshing.scenes import cameras_around, gradient, torus, trace
from tests.support.recorder import Recorder
from tests.support.slow import slow


def run(root: Path, out: Path, monitor: Recorder | None = None, surfels: str = "refine", **mesh: Any) -> Any:
    """The results of one run."""
    out.mkdir()
    options = MeshOptions(Mesh(**mesh), train_size=120)
    return extract_mesh(root / "poses", root / surfels, out, options, scratch=out.parent, monitor=monitor or Recorder())


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("mesh")
    for folder in ("poses/photos", "poses/masks", "refine"):
        (root / folder).mkdir(parents=True)
    cameras = cameras_around((-40, 5, 50), 5, 160)
    CameraSet(tuple(cameras)).save(root / "poses" / "cameras.json")
    for camera in cameras:
        mask = np.where(trace(torus, camera)[0] > 0, 255, 0).astype(np.uint8)
        cv2.imwrite(str(root / "poses" / "masks" / f"{camera.name}.png"), mask)
        cv2.imwrite(str(root / "poses" / "photos" / f"{camera.name}.png"), np.repeat(mask[..., None], 3, 2))
    points = np.random.default_rng(0).uniform(-0.9, 0.9, (9000, 3))
    for _ in range(12):
        points -= torus(points)[:, None] * gradient(torus, points)
    # Random points have gaps of about their mean spacing (0.023); discs nearly twice as wide cover them, like trained surfels.
    surfels = create(points, gradient(torus, points), np.full(len(points), 0.04), None, "colour", 0, 0.0, 4.0)
    surfels.save(root / "refine" / "surfels.safetensors")
    return root


@pytest.mark.parametrize("field", ["tsdf", "imls"])
def test_torus_is_reconstructed(capture: Path, tmp_path: Path, field: str) -> None:
    monitor, out = Recorder(), tmp_path / "out"
    results = run(capture, out, monitor, field=field, faces=3000, max_resolution=80)
    dense, low = (trimesh.load(out / name, process=False) for name in ("dense.ply", "mesh.ply"))
    assert results["dense_faces"] == len(dense.faces) and results["faces"] == len(low.faces) <= 3000
    for mesh in (dense, low):
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == 0  # a torus
        assert np.abs(torus(np.asarray(mesh.vertices))).mean() < 0.4 * results["cell"]
        assert mesh.volume == pytest.approx(2 * np.pi**2 * 0.55 * 0.22**2, rel=0.04)
    assert results["components"] == 1 and results["watertight"]
    assert results["decimation_error_cells"] < 2 and not monitor.warnings
    assert results["decimation_deviation_cells"] <= 0.5
    assert monitor.decisions["decimation"][0] == f"{len(low.faces)} faces"
    assert {"field resolution", "truncation"} <= set(monitor.decisions)
    assert "surfel spacing" in monitor.decisions["field resolution"][1]
    assert list(tmp_path.iterdir()) == [out]  # the depth cache is removed
    assert sorted(p.name for p in out.iterdir()) == ["dense.ply", "mesh.ply"]


@pytest.mark.parametrize(("max_error", "max_faces"), [(0.5, 0), slow(0.5, 320), slow(0.0, 0)])
def test_error_bound_raises_the_face_count(capture: Path, tmp_path: Path, max_error: float, max_faces: int) -> None:
    monitor = Recorder()
    results = run(capture, tmp_path / "out", monitor, faces=300, max_resolution=80, max_error=max_error, max_faces=max_faces)
    choice, evidence = monitor.decisions["decimation"]
    assert choice.startswith(f"{results['faces']} faces") and f"{results['decimation_deviation_cells']:.2f} voxels" in evidence
    if max_error == 0:
        assert results["faces"] <= 300 and results["decimation_deviation_cells"] > 0.5 and not monitor.warnings
    elif max_faces:
        assert 300 < results["faces"] <= 320 and len(monitor.warnings) == 1
        assert f"{results['decimation_deviation_cells']:.2f} voxels" in monitor.warnings[0]
    else:
        assert 300 < results["faces"] <= 1200 and results["decimation_deviation_cells"] <= 0.5 and not monitor.warnings
        assert "instead of 300" in choice


def test_maximum_face_count() -> None:
    """Four times mesh.faces, at most the export limit, never below mesh.faces; mesh.max_faces replaces it."""
    assert MeshOptions(Mesh(faces=20_000), max_triangles=100_000).max_faces == 80_000
    assert MeshOptions(Mesh(faces=60_000), max_triangles=100_000).max_faces == 100_000
    assert MeshOptions(Mesh(faces=60_000), max_triangles=50_000).max_faces == 60_000
    assert MeshOptions(Mesh(faces=20_000, max_faces=200_000), max_triangles=100_000).max_faces == 200_000
    assert MeshOptions(Mesh(faces=20_000, max_faces=10_000)).max_faces == 20_000


@pytest.mark.parametrize("support", ["remove", slow("keep")])
def test_without_masks_the_table_is_removed(tmp_path: Path, support: str) -> None:
    floor = -0.15
    for folder in ("poses/photos", "refine"):
        (tmp_path / folder).mkdir(parents=True)
    cameras = cameras_around((20, 50), 5, 160)
    CameraSet(tuple(cameras)).save(tmp_path / "poses" / "cameras.json")
    for camera in cameras:
        cv2.imwrite(str(tmp_path / "poses" / "photos" / f"{camera.name}.png"), np.full((camera.height, camera.width, 3), 90, np.uint8))
    rng = np.random.default_rng(0)
    body = rng.uniform(-0.9, 0.9, (9000, 3))
    for _ in range(12):
        body -= torus(body)[:, None] * gradient(torus, body)
    body = body[body[:, 2] > floor]
    angle, radius = rng.uniform(0, 2 * np.pi, 6000), np.sqrt(rng.uniform(0, 1, 6000))
    table = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6000, floor)], 1)
    points = np.concatenate([body, table])
    normals = np.concatenate([gradient(torus, body), np.tile([0.0, 0.0, 1.0], (6000, 1))])
    create(points, normals, np.full(len(points), 0.04), None, "colour", 0, 0.0, 4.0).save(tmp_path / "refine" / "surfels.safetensors")
    monitor, out = Recorder(), tmp_path / "out"
    results = run(tmp_path, out, monitor, faces=3000, max_resolution=80, support_plane=support)
    mesh = trimesh.load(out / "mesh.ply", process=False)
    max_radius = np.linalg.norm(np.asarray(mesh.vertices)[:, :2], axis=1).max()
    if support == "keep":
        assert "support plane" not in monitor.decisions and max_radius > 0.95
        return
    assert monitor.decisions["support plane"][0] == "removed"
    assert mesh.is_watertight and results["components"] == 1
    assert max_radius == pytest.approx(0.77, abs=2 * results["cell"])
    assert mesh.bounds[0][2] == pytest.approx(floor, abs=results["cell"])
    assert mesh.bounds[1][2] == pytest.approx(0.22, abs=results["cell"])


def test_the_mesh_ends_at_the_region(capture: Path, tmp_path: Path) -> None:
    """Half of the torus: closed by flat faces, though silhouettes draw these outwards."""
    shutil.copytree(capture, tmp_path / "half")
    region = Region(np.array([1.0, 0, 0]), np.array([2.0, 3, 3]), np.eye(3))
    (tmp_path / "half/poses/region.json").write_text(json.dumps(region.document))
    out = tmp_path / "out"
    results = run(tmp_path / "half", out, faces=2000, max_resolution=60)
    dense, low = (trimesh.load(out / name, process=False) for name in ("dense.ply", "mesh.ply"))
    for mesh in (dense, low):
        assert region.distance(np.asarray(mesh.vertices)).max() < 0.25 * results["cell"]
        assert mesh.is_watertight and mesh.volume == pytest.approx(np.pi**2 * 0.55 * 0.22**2, rel=0.1)


def test_no_surfels_is_bad_input(capture: Path, tmp_path: Path) -> None:
    from gsbake.surfels.model import Surfels

    far = Surfels.load(capture / "refine" / "surfels.safetensors").select(torch.arange(20))
    far.position[:] = 5.0
    (capture / "far").mkdir()
    far.save(capture / "far" / "surfels.safetensors")
    with pytest.raises(BadInputError, match="surfels"):
        run(capture, tmp_path / "out", surfels="far")


def test_what_untangling_cuts_off_is_removed(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cut_off = trimesh.creation.icosphere(subdivisions=1, radius=0.02)

    def cutting(vertices: Array, faces: Any, start: Array | None = None, rings: int = 4) -> tuple[Array, Any]:
        if start is None:
            return vertices, faces
        return np.concatenate([vertices, cut_off.vertices]), np.concatenate([faces, cut_off.faces + len(vertices)]).astype(np.int32)

    monkeypatch.setattr("gsbake.meshing.extract.untangle", cutting)
    results = run(capture, tmp_path / "out", faces=1000, max_resolution=40)
    assert results["components"] == 1 and results["dropped_components"] > 0


def test_photos_are_spread_evenly() -> None:
    """One photo more than there may be drops one, not every second."""
    assert evenly(list(range(97)), 96) == list(range(96))
    assert evenly([1, 3, 5, 7, 9, 11], 3) == [1, 5, 9] and evenly([4, 5], 96) == [4, 5] and evenly([], 96) == []
