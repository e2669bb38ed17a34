"""Repair of meshes whose faults are known, and filling of their holes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing.cleanup import topology
from gsbake.meshing.repair import close_holes, repair, repair_foreign, split_non_manifold_vertices

Mesh = tuple[np.ndarray, np.ndarray]


def sphere(subdivisions: int = 3) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)


def is_solid(mesh: Mesh) -> bool:
    """Closed, manifold and consistently wound, by trimesh's own judgement too."""
    checked = trimesh.Trimesh(*mesh, process=False)
    return topology(*mesh).watertight and checked.is_watertight and checked.is_winding_consistent


def test_holes_are_closed_up_to_a_maximum_size() -> None:
    vertices, faces = sphere()
    centre = vertices[faces].mean(1)
    small = faces[np.linalg.norm(centre - [0, 0, 1], axis=1) > 0.2]
    closed = close_holes(vertices, small, 60)
    assert is_solid(closed)
    # The patch lies between the removed cap and the plane of its edge.
    assert trimesh.Trimesh(*closed, process=False).volume == pytest.approx(trimesh.Trimesh(vertices, faces).volume, rel=2e-3)
    remaining = close_holes(vertices, faces[centre[:, 2] < 0.3], 20)
    assert topology(*remaining).border_edges > 20
    assert close_holes(vertices, faces, 60)[1] is faces


def test_a_hole_is_filled_with_least_area() -> None:
    """A square above an apex: the flat square has the least area."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, -3], [0.5, 0.0, 0], [0.5, 1, 0]])
    ring = [0, 5, 1, 2, 6, 3]
    skirt = np.array([[ring[(i + 1) % 6], ring[i], 4] for i in range(6)], np.int32)
    mesh = close_holes(vertices, skirt, 10)
    assert is_solid(mesh) and len(mesh[1]) == 10
    corners = vertices[mesh[1][6:]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(1)  # the flat square; any other surface over the ring is larger


def test_a_single_face_is_no_hole() -> None:
    """The only face over the boundary of a single face would be that face again."""
    assert len(close_holes(np.eye(3), np.array([[0, 1, 2]], np.int32), 10)[1]) == 1


def test_repair_leaves_a_manifold_mesh() -> None:
    """A third face on an edge, a degenerate face, a double face, a double vertex."""
    vertices, faces = sphere(2)
    vertices = np.concatenate([vertices, [[2.0, 0, 0]], vertices[:1]])
    extra = np.array([[faces[0, 0], faces[0, 1], len(vertices) - 2], [0, 0, 1], faces[3]], np.int32)
    duplicated = np.where(faces == 0, len(vertices) - 1, faces).astype(np.int32)
    duplicated[0] = faces[0]
    fixed = repair(vertices, np.concatenate([duplicated, extra]))
    found = topology(*fixed)
    assert found.non_manifold_edges == 0 and len(np.unique(fixed[0], axis=0)) == len(fixed[0])
    assert is_solid(close_holes(*fixed, 10))


def test_faces_back_to_back_cancel() -> None:
    """A flap: two faces on the same corners, one each way, on one edge of a sphere."""
    vertices, faces = sphere(2)
    tip = len(vertices)
    flap = np.array([[faces[0, 0], faces[0, 1], tip], [faces[0, 1], faces[0, 0], tip]], np.int32)
    vertices = np.concatenate([vertices, [[2.0, 0, 0]]])
    assert topology(vertices, np.concatenate([faces, flap])).non_manifold_edges == 1
    fixed = repair(vertices, np.concatenate([faces, flap]))
    assert is_solid(fixed) and len(fixed[1]) == len(faces) and len(fixed[0]) == tip


def test_touching_spheres_get_vertices_of_their_own() -> None:
    """Two spheres that share one vertex, and two that share an edge."""
    vertices, faces = sphere(1)
    n = len(vertices)
    both = np.concatenate([vertices, vertices + 5]), np.concatenate([faces, faces + n]).astype(np.int32)
    for shared in (faces[0, :1], faces[0, :2]):
        joined = both[1].copy()
        for vertex in shared:
            joined[joined == vertex + n] = vertex
        if len(shared) == 1:
            split = split_non_manifold_vertices(both[0], joined)
            assert is_solid(split) and topology(*split).components == 2 and len(split[0]) == 2 * n + 1
        fixed = close_holes(*repair(both[0], joined), 20)
        assert is_solid(fixed)
        assert trimesh.Trimesh(*fixed, process=True).is_watertight  # also for a program that merges vertices at equal positions


def with_fins(mesh: Mesh, count: int) -> Mesh:
    """The mesh with a triangle that stands on each of its first `count` edges."""
    vertices, faces = mesh
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)[:count]
    fins = np.column_stack([edges, len(vertices) + np.arange(count)])
    return np.concatenate([vertices, 1.02 * vertices[edges].mean(1)]), np.concatenate([faces, fins]).astype(np.int32)


def test_rough_meshes_of_other_programs_lose_their_faults_and_nothing_else() -> None:
    """A quarter of all edges with a third face, faces without area, double faces, vertices at one place: what is left is the sphere."""
    vertices, faces = sphere()
    soup = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3).astype(np.int32)
    joined = repair_foreign(*soup, 100)
    assert joined.joined == len(soup[0]) - len(vertices) and joined.faults == "" and is_solid((joined.vertices, joined.faces))
    rough, rough_faces = with_fins((vertices, faces), 3 * len(faces) // 8)
    flat = np.column_stack([faces[:200, 0], faces[:200, 1], faces[:200, 1]])
    found = repair_foreign(rough, np.concatenate([rough_faces, flat, faces[:7]]).astype(np.int32), 100)
    assert np.array_equal(found.faces, faces) and np.array_equal(found.vertices, vertices)
    assert (found.without_area, found.double, found.cut, found.filled) == (200, 7, 480, 0)
    assert found.faults == "200 faces without area, 7 double faces, 480 faces at 480 edges that had more than two (holes closed with 0)"


def test_holes_of_the_repair_are_closed_and_openings_stay() -> None:
    """Two spheres that share an edge, one of them open at the other end."""
    vertices, faces = sphere(2)
    n = len(vertices)
    second = faces[vertices[faces].mean(1)[:, 2] < 0.6] + n
    low = faces[vertices[faces].mean(1)[:, 2].argmin()][:2]
    for vertex in low:
        second[second == vertex + n] = vertex
    both = np.concatenate([vertices, vertices]) * [1, 1, 0.999], np.concatenate([faces, second]).astype(np.int32)
    both[0][n:] -= [0, 0, 2.5]  # the shared edge is drawn long; what counts is how faces are joined
    before = topology(*both)
    assert before.non_manifold_edges == 1 and before.border_edges > 10
    found = repair_foreign(*both, 100)
    after = topology(found.vertices, found.faces)
    assert after.non_manifold_edges == 0 and after.border_edges == before.border_edges and found.cut == found.filled > 0


def test_a_mesh_without_faults_is_the_same_mesh() -> None:
    vertices, faces = sphere(2)
    opened = faces[vertices[faces].mean(1)[:, 2] < 0.3]
    found = repair_foreign(vertices, opened, 100)
    assert found.vertices is vertices and found.faces is opened and found.faults == ""


def test_holes_that_meet_at_a_vertex_are_closed_too() -> None:
    """Five boxes, as pages of a book, that share one edge: all but one lose their faces there, and all are whole again."""
    box = trimesh.creation.box((1.0, 0.05, 1.0))
    corners, back = box.vertices + [0.5, 0.025, 0], []
    for angle in 2 * np.pi * np.arange(5) / 5:
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        back.append(np.round(corners @ turn.T, 9) + 0.0)
    faces = np.concatenate([box.faces + 8 * k for k in range(5)]).astype(np.int32)
    found = repair_foreign(np.concatenate(back), faces, 100)
    after = topology(found.vertices, found.faces)
    assert found.non_manifold == 1 and found.cut == found.filled == 8
    assert after.border_edges == after.non_manifold_edges == 0


def test_thousands_of_faces_at_one_edge() -> None:
    """Both directions alternate, all edges are free: the largest face of each direction stays. One face a round would take minutes."""
    count = 30_000
    angle, length = np.arange(count), 1 + np.arange(count) / count
    vertices = np.array([[0, 0, -1], [0, 0, 1], *np.stack([np.cos(angle) * length, np.sin(angle) * length, 0 * angle], 1)])
    faces = np.column_stack([angle % 2, 1 - angle % 2, 2 + angle]).astype(np.int32)
    found = repair_foreign(vertices, faces, 100)
    assert (found.non_manifold, found.cut, len(found.faces)) == (1, count - 2, 2)
    assert np.abs(found.vertices).max() > 0.9 and np.hypot(*found.vertices[:, :2].T).max() == pytest.approx(2, abs=1e-3)
    assert topology(found.vertices, found.faces).non_manifold_edges == 0


@pytest.mark.parametrize("faces", [np.zeros((0, 3), np.int32), np.array([[0, 0, 0]], np.int32), np.array([[0, 1, 2]] * 3, np.int32)])
def test_nothing_and_almost_nothing(faces: np.ndarray) -> None:
    vertices, left = repair(np.eye(3), faces)
    assert len(left) == len(vertices) // 3 <= 1
    assert len(close_holes(vertices, left, 10)[1]) == len(left)
