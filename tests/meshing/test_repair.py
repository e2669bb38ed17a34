"""Repair of meshes whose faults are known, and filling of their holes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.meshing.cleanup import topology
from gsbake.meshing.repair import close_holes, repair, split_non_manifold_vertices

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


@pytest.mark.parametrize("faces", [np.zeros((0, 3), np.int32), np.array([[0, 0, 0]], np.int32), np.array([[0, 1, 2]] * 3, np.int32)])
def test_nothing_and_almost_nothing(faces: np.ndarray) -> None:
    vertices, left = repair(np.eye(3), faces)
    assert len(left) == len(vertices) // 3 <= 1
    assert len(close_holes(vertices, left, 10)[1]) == len(left)
