"""Mesh operations on hostile meshes: finite vertices and valid faces, without warnings."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.surface_distance import surface_distances
from gsbake.meshing import cleanup as clean
from gsbake.meshing.decimation import decimate_to_error_bound
from gsbake.meshing.refinement.normals import NormalAccumulator, integrate_normals
from gsbake.meshing.refinement.photometric_measure import PatchTargets, PhotometricViews
from gsbake.meshing.repair import close_holes, repair
from gsbake.mvs.pyramids import Photo as StereoPhoto
from gsbake.shape_refinement.contour import find_contour_points
from gsbake.shape_refinement.refine import Level, RefinementOptions, refine_shape
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.surface import Surface
from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh
from tests.stress.meshes import MESHES, sphere
from tests.support.cameras import look_at

on_every_mesh = pytest.mark.parametrize("name", MESHES)
SIZE = 48
#: Cameras around the object, one inside it, one that looks away, and three at one place.
CAMERAS = [
    *(look_at((3 * np.cos(a), 3 * np.sin(a), 0.4), size=SIZE, focal=60, name=f"{i}") for i, a in enumerate(np.arange(6))),
    look_at((0.05, 0.0, 0.0), size=SIZE, focal=60, name="inside"),
    look_at((3.0, 0, 0), (6.0, 0, 0), size=SIZE, focal=60, name="away"),
    *(look_at((0.0, 3, 0), size=SIZE, focal=60, name=f"same {i}") for i in range(3)),
]


def assert_valid(vertices: np.ndarray, faces: np.ndarray) -> None:
    assert np.isfinite(vertices).all()
    assert faces.shape[1:] == (3,) and (len(faces) == 0 or (faces.min() >= 0 and faces.max() < len(vertices)))


@on_every_mesh
def test_repair_and_hole_filling(name: str) -> None:
    vertices, faces = MESHES[name]()
    fixed = repair(vertices, faces)
    assert_valid(*fixed)
    assert clean.topology(*fixed).non_manifold_edges == 0
    closed = close_holes(*fixed, 100)
    assert_valid(*closed)
    assert clean.topology(*closed).non_manifold_edges == 0


@on_every_mesh
def test_clean_up_and_smoothing(name: str) -> None:
    vertices, faces = MESHES[name]()
    kept_vertices, kept, _ = clean.remove_small_components(vertices, faces, 0.02)
    assert_valid(kept_vertices, kept)
    assert_valid(clean.smooth(kept_vertices, kept, 3), kept)
    normals = Surface(len(kept_vertices), kept).normals(kept_vertices)
    assert np.isfinite(normals).all()
    for target in (normals, np.zeros_like(normals), np.full_like(normals, np.nan)):
        confidence = np.where(np.isfinite(target).all(1), 1.0, 0.0)
        moved = integrate_normals(kept_vertices, kept, np.nan_to_num(target), confidence, 0.1, 0.01)
        assert_valid(moved, kept)
        assert len(kept) == 0 or np.abs(moved - kept_vertices).max() <= 0.01 * np.sqrt(3) + 1e-9 * np.abs(kept_vertices).max()


@on_every_mesh
@pytest.mark.parametrize("decimator", ["pymeshlab", "fast-simplification"])
def test_decimation(name: str, decimator: str) -> None:
    vertices, faces = MESHES[name]()
    for target in (1, 100):
        result = decimate_to_error_bound(vertices, faces, target, 4 * target, 0.01, decimator)  # type: ignore[arg-type]
        assert_valid(result.vertices, result.faces)
        assert len(result.faces) == 0 or np.isfinite([result.deviation.quantile, result.deviation.maximum]).all()
        if name in ("huge", "tiny", "tiny and far away", "inside out") and target == 100:
            assert 50 <= len(result.faces) <= 4 * target


@on_every_mesh
def test_surface_distances(name: str) -> None:
    vertices, faces = MESHES[name]()
    points = np.concatenate([vertices, [[0, 0, 0], [1e9, 0, 0], [1e-9, 0, 0]]])
    found = surface_distances(points, vertices, faces)
    assert (found >= 0).all() and (np.isfinite(found).all() or len(faces) == 0)


@on_every_mesh
def test_atlas(name: str) -> None:
    vertices, faces = MESHES[name]()
    try:
        atlas = make_atlas(vertices, faces, 128)
    except ValueError as error:
        assert "mesh" in str(error) and name in ("empty", "needle") or name.endswith("triangle") or name.startswith("collapsed")
        return
    assert np.isfinite(atlas.uv).all() and atlas.uv.min() >= 0 and atlas.uv.max() <= 1 and 0 <= atlas.fill <= 1
    assert len(atlas.faces) == len(faces)
    surface = UnwrappedMesh.of(vertices, faces, atlas, 128, 1)
    for array in (surface.position, surface.normal, surface.tangent, surface.texel_position, surface.texel_normal):
        assert np.isfinite(array).all()
    assert np.isfinite([surface.diagonal, surface.texel_size]).all()


def masks(kind: str) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    values = {"empty": 0, "full": 255, "half": 127}
    return [
        np.full((SIZE, SIZE), values[kind], np.uint8) if kind in values else rng.integers(0, 256, (SIZE, SIZE)).astype(np.uint8)
        for _ in CAMERAS
    ]


PHOTOS = ("noise", "black", "equal", "clipped")


def photos(kind: str) -> list[Photo]:
    rng = np.random.default_rng(0)
    values = {"noise": rng.random((SIZE, SIZE, 3)), "black": 0.0, "equal": 0.5, "clipped": 1.0}[kind]
    grey = np.broadcast_to(values, (SIZE, SIZE, 3)).astype(np.float32)
    return [Photo(camera, np.ascontiguousarray(grey), np.ones((SIZE, SIZE), np.float32)) for camera in CAMERAS]


@on_every_mesh
@pytest.mark.parametrize(("kind", "mask"), [*((k, "half") for k in PHOTOS), *(("noise", m) for m in ("empty", "full", "noise", "none"))])
def test_shape_refinement(name: str, kind: str, mask: str) -> None:
    vertices, faces = MESHES[name]()
    given = None if mask == "none" else lambda: zip(CAMERAS, masks(mask), strict=True)
    options = RefinementOptions(levels=(Level(16, 1, 1.0, False), Level(16, 2, 1.0)))
    assert_valid(refine_shape(vertices, faces, lambda blur: photos(kind), given, 0.05, options=options).vertices, faces)


@pytest.mark.parametrize("depth", [2.3, np.nan, np.inf, 0.0, -1.0, 1e-30, 1e30])
def test_patches_with_hostile_depths(depth: float) -> None:
    vertices, faces = sphere()
    grey = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE)).astype(np.uint8)
    given = [StereoPhoto(camera, grey, np.ones((SIZE, SIZE), np.uint8)) for camera in CAMERAS]
    stereo = np.full((SIZE, SIZE), depth, np.float32), np.ones((SIZE, SIZE), np.float32)
    measured = PatchTargets(PhotometricViews(CAMERAS, given.__getitem__, lambda index: stereo, 10.0), 1)
    options = RefinementOptions(levels=(Level(16, 1, 1.0),))
    found = refine_shape(vertices, faces, lambda blur: photos("noise"), None, 0.05, measured, options)
    assert_valid(found.vertices, faces)
    assert np.isfinite(list(found.figures.values())).all()


def test_contour_points_of_a_camera_in_a_vertex() -> None:
    vertices, faces = sphere()
    camera = look_at(vertices[0], size=SIZE, focal=60)
    surface = Surface(len(vertices), faces)
    points = find_contour_points(RayCaster(vertices, faces, 1), surface.normals(vertices), surface.edges, camera, masks("noise")[0])
    assert np.isfinite(points.offset).all() and np.isfinite(points.pixel).all()


@on_every_mesh
def test_normal_accumulation(name: str) -> None:
    from gsbake.meshing.depth_views import DepthView

    vertices, faces = MESHES[name]()
    accumulator = NormalAccumulator(vertices, 0.1)
    for camera in CAMERAS:
        depth = np.full((SIZE, SIZE), 2.3, np.float32)
        depth[::7], depth[1::7], depth[2::7] = np.nan, np.inf, 1e-30
        normal = np.full((SIZE, SIZE, 3), 0.577, np.float32)
        accumulator.add(DepthView.from_depth(camera, depth), normal)
    normals, agreement = accumulator.normals()
    assert np.isfinite(normals).all() and np.isfinite(agreement).all()
