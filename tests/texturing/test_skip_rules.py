"""Skip rules of the bake: exposure gains, normal map."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.capture.exposure import MAX_SPREAD
from gsbake.geometry.raycast import RayCaster
from gsbake.texturing.normal_map import sample_dense_mesh, vertex_normals
from gsbake.texturing.skip_rules import MAX_GAIN_SPREAD, MIN_EXPLAINED, constant_exposure, normals_agree


@pytest.mark.parametrize(
    ("gain", "constant"),
    [(1.0, True), (MAX_GAIN_SPREAD - 0.02, True), (MAX_GAIN_SPREAD + 0.02, False), (1 / (MAX_GAIN_SPREAD + 0.02), False)],
)
def test_exposure_is_constant_below_the_gain_threshold(gain: float, constant: bool) -> None:
    gains = np.ones((5, 3))
    gains[2, 1] = gain
    holds, evidence = constant_exposure(gains, 0.5)
    assert holds is constant and f"{max(gain, 1 / gain):.2f}x" in evidence


@pytest.mark.parametrize(("tie_point_spread", "constant"), [(MAX_SPREAD - 0.02, True), (MAX_SPREAD + 0.02, False), (None, False)])
def test_tie_points_decide_on_specular_surfaces(tie_point_spread: float | None, constant: bool) -> None:
    gains = np.ones((5, 3))
    gains[3] = 1.6
    assert constant_exposure(gains, 0.5, tie_point_spread)[0] is constant
    assert constant_exposure(np.ones((5, 3)), 0.5, tie_point_spread)[0]


@pytest.mark.parametrize(("explained", "constant"), [(MIN_EXPLAINED - 0.02, True), (MIN_EXPLAINED + 0.02, False)])
def test_gains_that_explain_little_are_reflections(explained: float, constant: bool) -> None:
    gains = np.ones((5, 3))
    gains[3] = 1.6
    holds, evidence = constant_exposure(gains, explained)
    assert holds is constant and f"{100 * explained:.0f} % of the differences" in evidence


def agreement(subdivisions: int, ripple: float) -> tuple[bool, str]:
    """`normals_agree` for a sphere of `subdivisions` against a fine one with ripples of height `ripple`."""
    coarse, fine = trimesh.creation.icosphere(subdivisions=subdivisions), trimesh.creation.icosphere(subdivisions=5)
    raised = fine.vertices * (1 + ripple * np.sin(12 * fine.vertices[:, :1]))
    dense = RayCaster(raised, fine.faces, 1)
    points, faces = trimesh.sample.sample_surface(coarse, 4000, seed=0)
    share = trimesh.triangles.points_to_barycentric(coarse.triangles[faces], points)
    normal = (vertex_normals(coarse.vertices, coarse.faces)[coarse.faces[faces]] * share[:, :, None]).sum(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normals_agree(sample_dense_mesh(points, normal, dense, vertex_normals(raised, fine.faces), 2 * np.sqrt(3)), normal)


def test_a_mesh_with_the_dense_normals_needs_no_map() -> None:
    holds, evidence = agreement(4, 0.0)
    assert holds and "95 %" in evidence


@pytest.mark.parametrize(("subdivisions", "ripple"), [(4, 0.01), (2, 0.006)])
def test_ripples_need_a_map(subdivisions: int, ripple: float) -> None:
    assert not agreement(subdivisions, ripple)[0]


def test_distant_dense_mesh_gives_no_map() -> None:
    away = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    dense = RayCaster(away.vertices + [5.0, 0, 0], away.faces, 1)
    normal = np.tile([0.0, 0, 1], (4, 1))
    detail = sample_dense_mesh(np.zeros((4, 3)), normal, dense, vertex_normals(dense.vertices, dense.faces), 2.0)
    holds, evidence = normals_agree(detail, normal)
    assert holds and "no dense surface" in evidence
