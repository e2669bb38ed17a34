"""Decimation with seams: quadrics against their definition, and what must hold of every decimated mesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.gltf.write import GltfMesh
from gsbake.meshing.decimation import surface_deviation
from gsbake.targets.collapse_kernel import FIXED, least_point, quadric_value
from gsbake.targets.decimation import WedgeMesh, decimate_to_bound, decimate_to_cost, decimate_to_count
from gsbake.targets.quadrics import crease_quadrics, triangle_quadrics
from gsbake.texturing.texels import overlapping


def plane_distance(corners: np.ndarray, point: np.ndarray) -> float:
    """Squared distance of a point (5,) from the plane through three others, by least squares."""
    edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], 1)
    offset = point - corners[0]
    return float(np.sum((offset - edges @ np.linalg.lstsq(edges, offset, rcond=None)[0]) ** 2))


def test_a_triangle_quadric_is_the_squared_distance_to_its_plane() -> None:
    rng = np.random.default_rng(1)
    corners, point = rng.normal(size=(3, 5)), rng.normal(size=(4, 5))
    quadric = triangle_quadrics(corners, np.array([[0, 1, 2]]))
    area = 0.5 * np.linalg.norm(np.cross((corners[1] - corners[0])[:3], (corners[2] - corners[0])[:3]))
    expected = [area / 3 * plane_distance(corners, p) for p in point]
    assert np.allclose([[quadric_value(q, p) for p in point] for q in quadric], [expected] * 3)
    assert np.allclose(quadric[:, 21], area / 3)


def test_a_crease_quadric_grows_across_the_edge_only() -> None:
    point = np.array([[0.0, 0, 0, 0, 0], [2, 0, 0, 1, 0]])
    quadric = crease_quadrics(point, np.array([[0, 1]]), np.array([[0.0, 0, 1]]))
    probe = np.array([[1.0, 0, 0, 0.4, 0], [1, 0, 5, 0.4, 0], [1, 0.5, 0, 0.4, 0], [1, 0, 0, 0.4, 0.25]])
    assert np.allclose([quadric_value(quadric[0], p) for p in probe], [0, 0, 4 * 0.25, 4 * 0.0625])


def test_the_least_point_is_where_the_gradient_vanishes() -> None:
    rng = np.random.default_rng(2)
    quadric = triangle_quadrics(rng.normal(size=(12, 5)), rng.permutation(12).reshape(4, 3)).sum(0)
    best = np.empty(5)
    assert least_point(quadric, np.zeros(5), best)
    steps = [np.zeros(5), *rng.normal(size=(20, 5)) * 1e-2]
    value = [quadric_value(quadric, best + d) + 1e-3 * quadric[21] * np.sum((best + d) ** 2) for d in steps]
    assert np.argmin(value) == 0


@pytest.fixture(scope="module")
def wedges(unwrapped: GltfMesh) -> WedgeMesh:
    return WedgeMesh.of(unwrapped)


def uv_areas(mesh: WedgeMesh) -> np.ndarray:
    a, b, c = (mesh.uv[mesh.faces[:, k]] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])


@pytest.mark.parametrize("share", [2, 4, 7])
def test_charts_seams_and_topology_are_kept(wedges: WedgeMesh, share: int) -> None:
    low = decimate_to_count(wedges, len(wedges.faces) // share)
    assert len(low.faces) <= len(wedges.faces) // share * 1.01
    solid = trimesh.Trimesh(*low.surface, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.euler_number == 2
    assert (np.sign(uv_areas(low)) == np.sign(uv_areas(wedges))[0]).all()
    assert overlapping(low.uv, low.faces, 1024) == 0
    fixed = np.flatnonzero(wedges.kind == FIXED)
    assert np.array_equal(low.position[fixed], wedges.position[fixed])
    assert set(fixed) <= set(low.vertex[low.faces.ravel()])


def test_texture_stays_where_it_is_on_the_surface(wedges: WedgeMesh) -> None:
    """Centres of decimated triangles: the texture there shows the surface within a texel or two."""
    low = decimate_to_count(wedges, len(wedges.faces) // 4)
    place, uv = low.position[low.vertex[low.faces]].mean(1), low.uv[low.faces].mean(1)
    corner = wedges.uv[wedges.faces]
    a, e1, e2 = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    det = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    d = uv[:, None] - a
    s = (d[..., 0] * e2[:, 1] - d[..., 1] * e2[:, 0]) / det
    t = (d[..., 1] * e1[:, 0] - d[..., 0] * e1[:, 1]) / det
    inside = np.minimum(np.minimum(s, t), 1 - s - t)
    face = inside.argmax(1)
    known = inside.max(1) > -1e-9
    assert known.mean() > 0.9
    row = np.arange(len(uv))
    p = wedges.position[wedges.vertex[wedges.faces[face]]]
    found = p[:, 0] + s[row, face, None] * (p[:, 1] - p[:, 0]) + t[row, face, None] * (p[:, 2] - p[:, 0])
    slip = np.linalg.norm(found - place, axis=1)[known]
    assert np.median(slip) < 0.01 and np.quantile(slip, 0.95) < 0.04


def test_the_error_bound_is_kept(wedges: WedgeMesh) -> None:
    for bound in (0.01, 0.03):
        low, deviation = decimate_to_bound(wedges, bound)
        measured = surface_deviation(wedges.surface, low.surface)
        assert measured.quantile == deviation.quantile <= bound
        assert len(low.faces) < len(wedges.faces) / 2


def test_a_flat_sheet_keeps_its_border() -> None:
    """A square of 200 triangles is two; its border stays where it is."""
    x, y = np.meshgrid(np.linspace(0, 1, 11), np.linspace(0, 1, 11))
    flat = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1).astype(np.float32)
    start = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.concatenate([np.stack([start, start + 1, start + 12], 1), np.stack([start, start + 12, start + 11], 1)])
    normal, tangent = np.tile(np.float32([0, 0, 1]), (121, 1)), np.tile(np.float32([1, 0, 0, 1]), (121, 1))
    mesh = WedgeMesh.of(GltfMesh(flat, normal, tangent, flat[:, :2] * [0.5, -0.5] + [0.25, 0.75], faces.astype(np.int32)))
    low = decimate_to_cost(mesh, 1e-6)
    assert len(low.faces) <= 24
    p = low.position[low.vertex[np.unique(low.faces)]]
    assert np.allclose(p.min(0), 0, atol=1e-6) and np.allclose(p.max(0), [1, 1, 0], atol=1e-6)
    corner = low.position[low.vertex[low.faces]]
    assert np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() == pytest.approx(2)
