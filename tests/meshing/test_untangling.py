"""Untangling of random and of known folds: nothing crosses or lies inside out, and what was sound keeps its place and its topology."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.geometry.self_intersection import self_intersecting_faces
from gsbake.geometry.surface_distance import surface_distances
from gsbake.meshing.cleanup import remove_unused_vertices, topology
from gsbake.meshing.decimation import decimate_to_error_bound
from gsbake.meshing.decimator_choice import Decimator
from gsbake.meshing.untangling import inside_out_faces, untangle

Mesh = tuple[np.ndarray, np.ndarray]


def sphere(subdivisions: int = 4) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)


def ripped(vertices: np.ndarray, seed: int, places: int = 5, strength: float = 3.0) -> np.ndarray:
    """Some places with vertices thrown about by some edges."""
    rng = np.random.default_rng(seed)
    centres = vertices[rng.choice(len(vertices), places, replace=False)]
    near = np.linalg.norm(vertices[:, None] - centres, axis=2).min(1) < 0.15
    edge = np.sqrt(4 * np.pi / len(vertices))
    return vertices + near[:, None] * strength * edge * rng.normal(size=vertices.shape)


def assert_sound(mesh: Mesh, rings: int = 4) -> None:
    assert not self_intersecting_faces(*mesh).any() and not inside_out_faces(*mesh, rings).any()
    checked = trimesh.Trimesh(*mesh, process=False)
    assert topology(*mesh).watertight and checked.is_winding_consistent and checked.volume > 0


@pytest.mark.parametrize("seed", range(6))
def test_random_folds(seed: int) -> None:
    vertices, faces = sphere()
    bad = ripped(vertices, seed)
    assert self_intersecting_faces(bad, faces).sum() > 50
    fixed = untangle(bad, faces)
    assert_sound(fixed)
    kept = {tuple(p) for p in fixed[0]} & {tuple(p) for p in bad}
    assert len(kept) > 0.75 * len(vertices)
    assert surface_distances(fixed[0], vertices, faces).max() < 0.25  # the depth of a cap as wide as two places


@pytest.mark.parametrize("scale", [1e-6, 1e4])
def test_the_scale_does_not_matter(scale: float) -> None:
    vertices, faces = sphere()
    bad = ripped(vertices, 0)
    one, other = untangle(bad, faces), untangle(scale * bad, faces)
    np.testing.assert_array_equal(one[1], other[1])
    np.testing.assert_allclose(one[0], other[0] / scale, atol=1e-9)


def test_folded_displacements_keep_the_shape_that_was_there() -> None:
    """Ribs of two edges' height: the membrane over a tangled region loses them, that of the displacements does not."""
    vertices, faces = sphere(5)
    ribbed = vertices * (1 + 0.03 * np.sin(25 * vertices[:, 2:]))
    assert not self_intersecting_faces(ribbed, faces).any()
    moved = ripped(ribbed + 0.02, 3, strength=1.5)
    with_start, without = untangle(moved, faces, ribbed), untangle(moved, faces)
    assert_sound(with_start)
    assert with_start[1] is faces

    def error(mesh: Mesh) -> float:
        return float(surface_distances(ribbed + 0.02, *mesh).max())

    assert error(with_start) < 0.5 * error(without)


def test_a_sound_mesh_is_unchanged() -> None:
    vertices, faces = sphere()
    ridged = vertices * (1 + 0.3 * (np.abs(vertices[:, :1]) < 0.05))
    for points in (vertices, ridged):
        fixed = untangle(points, faces)
        assert fixed[0] is points or np.array_equal(fixed[0], points)
        assert fixed[1] is faces


def test_a_crossing_handle_is_cut_off() -> None:
    """A torus that is pinched to a neck through itself becomes a closed surface without crossings."""
    ring = trimesh.creation.torus(1.0, 0.3, major_sections=64, minor_sections=32)
    vertices, faces = np.asarray(ring.vertices).copy(), np.asarray(ring.faces, np.int32)
    angle = np.arctan2(vertices[:, 1], vertices[:, 0])
    axis = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    neck = np.abs(angle)[:, None] < 0.1
    turned = np.where(neck, axis - 0.3 * (vertices - axis), vertices)  # inside out
    assert self_intersecting_faces(turned, faces).any()
    fixed = untangle(turned, faces)
    assert_sound(fixed)


def test_an_opening_stays_open() -> None:
    vertices, faces = sphere()
    vertices, faces = remove_unused_vertices(vertices, faces[vertices[faces].mean(1)[:, 2] < 0.5])
    bad = ripped(vertices, 2) * [1, 1, 1]
    rim = topology(vertices, faces).border_edges
    fixed = untangle(bad, faces)
    assert not self_intersecting_faces(*fixed).any()
    assert topology(*fixed).non_manifold_edges == 0 and abs(topology(*fixed).border_edges - rim) < 0.3 * rim


def test_what_is_nothing_but_tangled_is_left_alone() -> None:
    vertices, faces = sphere(2)
    chaos = np.random.default_rng(0).normal(size=vertices.shape)
    fixed = untangle(chaos, faces)
    assert topology(*fixed).watertight
    empty = untangle(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert len(empty[1]) == 0
    flat = untangle(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))
    assert len(flat[1]) == 1


@pytest.mark.parametrize("decimator", ["pymeshlab", "fast-simplification"])
def test_decimated_meshes_do_not_cross_themselves(decimator: Decimator) -> None:
    """Thin shells, 1 % of their size apart: collapses on one side reach through the other."""
    vertices, faces = sphere(5)
    inner = vertices * (0.985 + 0.01 * np.sin(9 * vertices[:, :1]))
    shell = np.concatenate([vertices, inner]), np.concatenate([faces, faces[:, ::-1] + len(vertices)]).astype(np.int32)
    result = decimate_to_error_bound(*shell, 3000, 3000, 0.0, decimator)
    assert not self_intersecting_faces(result.vertices, result.faces).any()
    assert result.topology.watertight
