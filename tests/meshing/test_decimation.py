"""Decimation under an error bound: thin features get more faces, smooth surfaces do not."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest
import trimesh

from gsbake.errors import UsageError
from gsbake.meshing import cleanup as clean
from gsbake.meshing.cleanup import topology
from gsbake.meshing.decimation import MAX_RETRIES, DecimatedMesh, Deviation, decimate_to_error_bound, surface_deviation
from gsbake.meshing.decimator_choice import Decimator
from gsbake.meshing.decimators import decimate, remesh

Mesh = tuple[np.ndarray, np.ndarray]
#: Radius of the rings and of their tubes; one voxel is a tenth of a tube's radius.
RADIUS, TUBE = 0.5, 0.02
VOXEL = TUBE / 10


#: Tests with this argument run with each library.
both_libraries = pytest.mark.parametrize("decimator", ["pymeshlab", "fast-simplification"])


def sphere(subdivisions: int = 5) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)


def thin_rings() -> Mesh:
    """Two parallel thin tori of 18 432 faces each: high curvature everywhere."""
    ring = trimesh.creation.torus(RADIUS, TUBE, major_sections=288, minor_sections=32)
    both = trimesh.util.concatenate([ring, ring.copy().apply_translation([0, 0, 0.1])])
    return np.asarray(both.vertices), np.asarray(both.faces, np.int32)


def distance_to_rings(points: np.ndarray) -> np.ndarray:
    """Distance to the analytic tori."""
    height = points[:, 2] - 0.1 * (points[:, 2] > 0.05)
    return np.abs(np.hypot(np.hypot(points[:, 0], points[:, 1]) - RADIUS, height) - TUBE)


def samples(mesh: DecimatedMesh) -> np.ndarray:
    return np.concatenate([mesh.vertices, mesh.vertices[mesh.faces].mean(1)])


@both_libraries
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_decimation_keeps_the_shape(decimator: Decimator, scale: float) -> None:
    vertices, faces = sphere()
    result = decimate_to_error_bound(vertices * scale, faces, 1000, 4000, 0.0, decimator)
    result = replace(result, vertices=result.vertices / scale, deviation=Deviation(*(np.array(astuple(result.deviation)) / scale)))
    assert 900 <= len(result.faces) <= 1000 and result.retries == 0
    assert result.topology == clean.topology(result.vertices, result.faces) and result.topology.watertight
    # A chord of an even mesh of 1000 faces has a sagitta of edge²/8r, edge² = 4/√3 · area: about 0.4 %.
    assert result.deviation.quantile <= result.deviation.maximum < 0.012
    assert astuple(result.deviation) == pytest.approx(astuple(surface_deviation((vertices, faces), (result.vertices, result.faces))))
    assert trimesh.Trimesh(result.vertices, result.faces, process=False).volume == pytest.approx(4 / 3 * np.pi, rel=0.01)


def test_deviation_is_two_sided() -> None:
    """A second sphere at distance 3 is far from the first one, not the other way round."""
    vertices, faces = sphere(3)
    both = np.concatenate([vertices, vertices + [5, 0, 0]]), np.concatenate([faces, faces + len(vertices)]).astype(np.int32)
    for pair in (((vertices, faces), both), (both, (vertices, faces))):
        found = surface_deviation(*pair)
        assert found.maximum == pytest.approx(5, abs=0.02) and 3 < found.quantile <= found.maximum
    same = surface_deviation(both, both)
    assert same.maximum == pytest.approx(0, abs=1e-9)


@both_libraries
def test_smooth_surface_keeps_its_face_count(decimator: Decimator) -> None:
    vertices, faces = sphere()
    free = decimate_to_error_bound(vertices, faces, 1000, 4000, 0.0, decimator)
    bounded = decimate_to_error_bound(vertices, faces, 1000, 4000, 1.5 * free.deviation.quantile, decimator)
    assert bounded.retries == 0
    np.testing.assert_array_equal(bounded.vertices, free.vertices)
    np.testing.assert_array_equal(bounded.faces, free.faces)


@both_libraries
def test_thin_features_raise_the_face_count(decimator: Decimator) -> None:
    vertices, faces = thin_rings()
    target, bound = 2000, 0.5 * VOXEL
    free = decimate_to_error_bound(vertices, faces, target, 4 * target, 0.0, decimator)
    assert free.deviation.quantile > bound and len(free.faces) <= target
    stops: list[int] = []
    bounded = decimate_to_error_bound(vertices, faces, target, 4 * target, bound, decimator, lambda: stops.append(1))
    assert bounded.deviation.quantile <= bound
    assert 1.2 * target < len(bounded.faces) <= 4 * target
    assert len(stops) == bounded.retries >= 1
    # Independent of the measure used by the bound: distances to the analytic tori, whose tessellation lies within 1 % of the tube.
    assert np.quantile(distance_to_rings(samples(bounded)), 0.999) < bound + 0.01 * TUBE
    assert np.quantile(distance_to_rings(samples(free)), 0.999) > bound


@both_libraries
def test_the_bound_is_missed_at_the_maximum(decimator: Decimator) -> None:
    vertices, faces = thin_rings()
    capped = decimate_to_error_bound(vertices, faces, 2000, 3000, 0.01 * VOXEL, decimator)
    assert len(capped.faces) <= 3000 and capped.retries == 1
    assert capped.deviation.quantile > 0.01 * VOXEL


def test_retries_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A deviation slightly above the bound grows the target by the minimum factor per retry."""
    from gsbake.meshing import decimation

    targets: list[int] = []

    def fixed(vertices: np.ndarray, faces: np.ndarray, target: int, decimator: str) -> Mesh:
        targets.append(target)
        return vertices, faces

    monkeypatch.setattr(decimation, "decimate", fixed)
    monkeypatch.setattr(decimation, "surface_deviation", lambda first, second: decimation.Deviation(1.01, 1.01))
    result = decimate_to_error_bound(*sphere(3), 100, 10**6, 1.0, "pymeshlab")
    assert targets == [100, 125, 157, 197] and result.retries == MAX_RETRIES


def test_a_mesh_with_fewer_faces_is_unchanged() -> None:
    vertices, faces = sphere(3)
    result = decimate_to_error_bound(vertices, faces, len(faces), 4 * len(faces), 1e-9, "pymeshlab")
    assert np.array_equal(result.faces, faces) and result.deviation.maximum == 0 and result.retries == 0


@both_libraries
def test_boundaries_are_kept(decimator: Decimator) -> None:
    """The rim of a half sphere keeps its vertices."""
    vertices, faces = sphere()
    faces = faces[vertices[faces].mean(1)[:, 2] < 0.01]
    vertices, faces = clean.remove_unused_vertices(vertices, faces)
    low_poly = decimate(vertices, faces, 1500, decimator)
    assert clean.topology(*low_poly).border_edges == clean.topology(vertices, faces).border_edges > 50
    assert low_poly[0][:, 2].max() == pytest.approx(vertices[:, 2].max())


@both_libraries
def test_closed_meshes_stay_closed_and_manifold(decimator: Decimator) -> None:
    """Many thin tubes: collapses across their narrow ends make non-manifold edges, which are repaired."""
    rng = np.random.default_rng(0)
    tubes = [trimesh.creation.torus(0.2, 0.004, major_sections=40, minor_sections=5) for _ in range(60)]
    mesh = trimesh.util.concatenate([tube.apply_translation(rng.uniform(-1, 1, 3)) for tube in tubes])
    result = decimate_to_error_bound(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), 3000, 3000, 0.0, decimator)
    assert result.topology.watertight and len(result.faces) <= 3000
    assert trimesh.Trimesh(result.vertices, result.faces, process=False).is_winding_consistent


@both_libraries
def test_flat_faces_stay_flat_and_give_their_triangles_to_the_curved_part(decimator: Decimator) -> None:
    """A finely meshed cube with a dome on top, 49 152 faces, to 800."""
    box = trimesh.creation.box((1, 1, 1))
    for _ in range(6):
        box = box.subdivide()
    vertices, faces = np.asarray(box.vertices).copy(), np.asarray(box.faces, np.int32)
    radius = np.minimum(0.3, np.linalg.norm(vertices[:, :2], axis=1))
    vertices[:, 2] += np.where(vertices[:, 2] > 0.49, 0.5 * np.sqrt(0.09 - radius**2), 0)
    low = decimate(vertices, faces, 800, decimator)
    assert surface_deviation((vertices, faces), low).quantile < 0.003
    corners = low[0][low[1]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    below = corners[..., 2].max(1) < 0.49
    assert below.sum() < 250  # of 800, on more than four fifths of the area
    assert np.degrees(np.arccos(np.minimum(1, np.abs(normals[below]).max(1)))).max() < 0.1


def test_remeshed_has_at_most_so_many_vertices_without_pymeshlab() -> None:
    vertices, faces = sphere(4)
    coarse, coarse_faces = remesh(vertices, faces, 0.1, 300, "fast-simplification")
    assert 150 < len(coarse) <= 310 and topology(coarse, coarse_faces).watertight
    assert remesh(vertices, faces, 0.1, 10_000, "fast-simplification")[0] is vertices


@pytest.mark.parametrize("work", [lambda mesh: remesh(*mesh, 0.1, 300, "pymeshlab"), lambda mesh: decimate(*mesh, 300, "pymeshlab")])
def test_pymeshlab_that_does_not_load_is_one_sentence(monkeypatch: pytest.MonkeyPatch, work: Callable[[Any], Any]) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(UsageError, match="pymeshlab does not load"):
        work(sphere(4))
