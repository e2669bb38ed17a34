"""Decimation under an error bound: thin features get more faces, smooth surfaces do not."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing import cleanup as clean
from gsbake.meshing.decimation import MAX_RETRIES, DecimatedMesh, decimate_to_error_bound, surface_deviation

Mesh = tuple[np.ndarray, np.ndarray]
#: Radius of the rings and of their tubes; one voxel is a tenth of a tube's radius.
RADIUS, TUBE = 0.5, 0.02
VOXEL = TUBE / 10


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


def test_decimation_keeps_the_shape() -> None:
    vertices, faces = sphere()
    result = decimate_to_error_bound(vertices, faces, 1000, 4000, 0.0)
    assert 900 <= len(result.faces) <= 1000 and result.retries == 0
    assert result.topology == clean.topology(result.vertices, result.faces) and result.topology.watertight
    # A chord of an even mesh of 1000 faces has a sagitta of edge²/8r, edge² = 4/√3 · area: about 0.4 %.
    assert result.deviation.quantile <= result.deviation.maximum < 0.012
    assert result.deviation == surface_deviation((vertices, faces), (result.vertices, result.faces))
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


def test_smooth_surface_keeps_its_face_count() -> None:
    vertices, faces = sphere()
    free = decimate_to_error_bound(vertices, faces, 1000, 4000, 0.0)
    bounded = decimate_to_error_bound(vertices, faces, 1000, 4000, 1.5 * free.deviation.quantile)
    assert bounded.retries == 0
    np.testing.assert_array_equal(bounded.vertices, free.vertices)
    np.testing.assert_array_equal(bounded.faces, free.faces)


def test_thin_features_raise_the_face_count() -> None:
    vertices, faces = thin_rings()
    target, bound = 4000, 0.5 * VOXEL
    free = decimate_to_error_bound(vertices, faces, target, 4 * target, 0.0)
    assert free.deviation.quantile > bound and len(free.faces) <= target
    stops: list[int] = []
    bounded = decimate_to_error_bound(vertices, faces, target, 4 * target, bound, lambda: stops.append(1))
    assert bounded.deviation.quantile <= bound
    assert 1.4 * target < len(bounded.faces) <= 4 * target
    assert len(stops) == bounded.retries >= 1
    # Independent of the measure used by the bound: distances to the analytic tori, whose tessellation lies within 1 % of the tube.
    assert np.quantile(distance_to_rings(samples(bounded)), 0.999) < bound + 0.01 * TUBE
    assert np.quantile(distance_to_rings(samples(free)), 0.999) > bound


def test_the_bound_is_missed_at_the_maximum() -> None:
    vertices, faces = thin_rings()
    capped = decimate_to_error_bound(vertices, faces, 2000, 3000, 0.01 * VOXEL)
    assert len(capped.faces) <= 3000 and capped.retries == 1
    assert capped.deviation.quantile > 0.01 * VOXEL


def test_retries_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A deviation slightly above the bound grows the target by the minimum factor per retry."""
    from gsbake.meshing import decimation

    targets: list[int] = []

    def fixed(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
        targets.append(target)
        return vertices, faces

    monkeypatch.setattr(decimation, "decimate", fixed)
    monkeypatch.setattr(decimation, "surface_deviation", lambda first, second: decimation.Deviation(1.01, 1.01))
    result = decimate_to_error_bound(*sphere(3), 100, 10**6, 1.0)
    assert targets == [100, 150, 225, 338] and result.retries == MAX_RETRIES


def test_a_mesh_with_fewer_faces_is_unchanged() -> None:
    vertices, faces = sphere(3)
    result = decimate_to_error_bound(vertices, faces, len(faces), 4 * len(faces), 1e-9)
    assert np.array_equal(result.faces, faces) and result.deviation.maximum == 0 and result.retries == 0
