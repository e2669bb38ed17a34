"""Distance fields, hole filling and mesh extraction from hostile depths and surfels: a finite mesh, or a sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from gsbake.config.schema import Mesh
from gsbake.errors import GsbakeError
from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.meshing.depth_views import DepthView, depth_noise
from gsbake.meshing.extract import MeshOptions, extract_mesh
from gsbake.meshing.hole_filling import minimise_area, sign_change_blocks, solve_laplace
from gsbake.meshing.marching_cubes import extract_isosurface
from gsbake.meshing.resolution import choose_resolution, pixel_footprint
from gsbake.meshing.support_plane import find_support_plane
from gsbake.meshing.tsdf import SparseTsdf
from gsbake.surfels.fields.imls import imls_field
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.spacing import surfel_spacing
from tests.stress.captures import CAMERAS, SIZE, around, masks, photos, write
from tests.support.recorder import Recorder

CELL = 0.1
#: Values of a depth map, and a map of them all.
DEPTHS: dict[str, Any] = {str(value): value for value in (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-30, 1e-6, 2.5, 1e6, 1e30)}
DEPTHS["all"] = np.resize(np.array([*DEPTHS.values(), 2.6, 2.7], np.float32), SIZE * SIZE).reshape(SIZE, SIZE)


def depth_map(kind: str) -> np.ndarray:
    return np.broadcast_to(np.float32(DEPTHS[kind]), (SIZE, SIZE)).copy()


@pytest.mark.parametrize("mask", ["disc", "empty", "none"])
@pytest.mark.parametrize("kind", DEPTHS)
def test_fusion_of_hostile_depths(kind: str, mask: str) -> None:
    outline = (masks(mask, 1) or [None])[0]
    views = [DepthView.from_depth(camera, depth_map(kind), mask=outline) for camera in around()]
    assert all(np.isfinite(getattr(view, name)).all() for view in views for name in ("inverse", "weight", "cosine", "mask_distance"))
    noise = depth_noise(views[0], views[1])
    assert noise is None or np.isfinite(noise)
    field = SparseTsdf([-1] * 3, [1] * 3, CELL, 4 * CELL, ball=1.05, empty_outside=mask != "none")
    for view in views:
        field.fuse_coarse(view)
    field.allocate()
    for view in views:
        field.integrate(view)
    vertices, faces = field.mesh()
    assert np.isfinite(vertices).all() and (len(faces) == 0 or faces.max() < len(vertices))
    assert len(vertices) == 0 or np.abs(vertices).max() < 1.5


@pytest.mark.parametrize("cameras", CAMERAS)
def test_fusion_from_degenerate_cameras(cameras: str) -> None:
    field = SparseTsdf([-1] * 3, [1] * 3, CELL, 4 * CELL, ball=1.05)
    views = [DepthView.from_depth(camera, depth_map("2.5"), mask=np.full((SIZE, SIZE), 255, np.uint8)) for camera in CAMERAS[cameras]()]
    for view in views:
        field.fuse_coarse(view)
    field.allocate()
    for view in views:
        field.integrate(view)
    vertices, _ = field.mesh(close=False)
    assert np.isfinite(vertices).all()


@pytest.mark.parametrize("buffers", ["nan", "inf", "zero", "negative"])
def test_rendered_depths(buffers: str) -> None:
    value = {"nan": np.nan, "inf": np.inf, "zero": 0.0, "negative": -1.0}[buffers]
    maps = {name: np.full((SIZE, SIZE), value, np.float32) for name in ("alpha", "depth", "median_depth")}
    maps["normal"] = np.full((SIZE, SIZE, 3), value, np.float32)
    for name in maps:
        good = {"alpha": 1.0, "depth": 2.5, "median_depth": 2.5, "normal": -0.6}
        mixed = {k: np.full_like(v, good[k]) for k, v in maps.items()} | {name: maps[name]}
        view = DepthView.from_gbuffer(around()[0], mixed, None, 0.1)
        assert all(np.isfinite(getattr(view, plane)).all() for plane in ("inverse", "weight", "cosine"))
        assert (view.weight >= 0).all()


POINTS: dict[str, np.ndarray] = {
    "none": np.zeros((0, 3)),
    "one": np.array([[0.1, 0.2, 0.3]]),
    "two at one place": np.array([[0.1, 0.2, 0.3]] * 2),
    "all at one place": np.full((500, 3), 0.1),
    "on a line": np.linspace(-0.5, 0.5, 500)[:, None] * [1, 0, 0],
    "on a plane": np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * [1, 1, 0],
    "far away": np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) + 1e6,
    "tiny": 1e-6 * np.random.default_rng(0).normal(size=(500, 3)),
    "not finite": np.where(np.arange(1500).reshape(500, 3) % 7 == 0, np.nan, 0.2),
}


@pytest.mark.parametrize("normals", ["unit", "zero", "nan"])
@pytest.mark.parametrize("kind", POINTS)
def test_imls(kind: str, normals: str) -> None:
    points = POINTS[kind]
    normal = np.tile({"unit": [0, 0, 1.0], "zero": [0.0] * 3, "nan": [np.nan] * 3}[normals], (len(points), 1))
    lattice = BlockLattice([-1] * 3, [1] * 3, CELL)
    lattice.allocate_all()
    for weights in (None, np.zeros(len(points)), np.full(len(points), 1e30)):
        field = imls_field(lattice, points, normal, 4 * CELL, weights)
        known = field[np.isfinite(field)]
        assert len(known) == 0 or np.abs(known).max() <= 1
        vertices, _ = extract_isosurface(lattice, field)
        assert np.isfinite(vertices).all()


@pytest.mark.parametrize("kind", POINTS)
def test_resolution_and_support_plane(kind: str) -> None:
    points = POINTS[kind][np.isfinite(POINTS[kind]).all(1)]
    resolution = choose_resolution(float(np.ptp(points, axis=0).max()) if len(points) else 1.0, surfel_spacing(points), 0.01, 0, 384)
    assert resolution.cells >= 1 and np.isfinite(resolution.cell)
    for cameras in CAMERAS.values():
        views = cameras()
        assert pixel_footprint(views, np.zeros(3)) > 0
        normals, weights = np.tile([0, 0, 1.0], (len(points), 1)), np.ones(len(points))
        found, why = find_support_plane(points, normals, weights, np.stack([c.centre for c in views]), 0)
        assert why and (found is None or np.isfinite(found.cut))


@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, 1e30, np.nan])
def test_hole_filling_of_a_constant_field(value: float) -> None:
    lattice = BlockLattice([-1] * 3, [1] * 3, CELL)
    lattice.allocate_all()
    values = np.full((len(lattice), 8, 8, 8), value, np.float32)
    for unknown in (np.ones(values.shape, bool), np.zeros(values.shape, bool)):
        filled = values.copy()
        solve_laplace(lattice, filled, unknown, 5, 1.8)
        minimise_area(lattice, filled, unknown, sign_change_blocks(lattice, filled, unknown), 5, 1.8, 2)
        assert np.array_equal(filled, values, equal_nan=True) or np.isfinite(filled).all()


def ball(count: int = 400) -> Surfels:
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return create(0.5 * points, points, np.full(count, 0.08), None, "colour", 0, 0.0, 4.0)


def spoilt(kind: str) -> Surfels:
    surfels = ball()
    bad = {"nan": float("nan"), "inf": float("inf"), "huge": 1e6, "tiny": 1e-6, "zero": 0.0}
    where, _, what = kind.partition(" ")
    if kind == "plain":
        return surfels
    if where == "some":
        surfels.position[::3] = bad[what]
    elif where == "positions":
        surfels.position[:] = surfels.position * bad[what]
    else:
        getattr(surfels, where)[:] = bad[what]
    return surfels


SPOILT = (
    "plain", "some nan", "some inf", "some huge", "some zero", "positions tiny", "positions huge", "positions zero", "positions nan",
    "quaternion zero", "quaternion nan", "log_scale huge", "log_scale nan", "log_scale inf", "sdf huge", "sdf nan", "gamma zero",
    "gamma nan", "gamma huge",
)  # fmt: skip
CASES = [
    *((kind, "plain", "disc") for kind in SPOILT),
    *(("plain", cameras, "disc") for cameras in CAMERAS if cameras != "plain"),
    *(("plain", "plain", mask) for mask in ("empty", "full", "none", "one pixel")),
]

#: The cases that run with the quick tests.
QUICK = {("plain", "plain", "disc"), ("some nan", "plain", "disc"), ("sdf nan", "plain", "disc"), ("plain", "plain", "empty")}


def check(folder: Path, kind: str, cameras: str, mask: str, **settings: Any) -> None:
    views = CAMERAS[cameras]()
    poses = write(folder / "poses", views, photos("noise", len(views)), masks(mask, len(views)))
    (folder / "refine").mkdir()
    with torch.no_grad():
        spoilt(kind).save(folder / "refine" / "surfels.safetensors")
    out = folder / "out"
    out.mkdir()
    options = MeshOptions(Mesh(**{"resolution": 24, "faces": 500} | settings), train_size=SIZE)
    try:
        results = extract_mesh(poses, folder / "refine", out, options, scratch=folder, monitor=Recorder())
    except GsbakeError as error:
        assert str(error).startswith("mesh: ") and len(str(error)) > 30
        return
    assert np.isfinite([value for value in results.values() if isinstance(value, float | int)]).all()
    for name in ("dense.ply", "mesh.ply"):
        mesh = trimesh.load(out / name, process=False)
        assert len(mesh.faces) and np.isfinite(mesh.vertices).all() and np.abs(mesh.vertices).max() < 1.5


@pytest.mark.parametrize(
    ("kind", "cameras", "mask"), [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES]
)
def test_mesh_extraction_is_finite(tmp_path: Path, kind: str, cameras: str, mask: str) -> None:
    check(tmp_path, kind, cameras, mask)


@pytest.mark.stress
@pytest.mark.parametrize(
    "settings",
    [
        {"resolution": 0, "max_resolution": 64},
        {"field": "imls"},
        {"holes": "leave"},
        {"decimator": "fast-simplification"},
        {"max_error": 0.0},
    ],
)
@pytest.mark.parametrize(("kind", "cameras", "mask"), CASES)
def test_mesh_extraction_with_other_settings(tmp_path: Path, kind: str, cameras: str, mask: str, settings: dict[str, Any]) -> None:
    check(tmp_path, kind, cameras, mask, **settings)
