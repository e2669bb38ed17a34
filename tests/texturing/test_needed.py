"""When the bake leaves out exposure gains and the normal map, and what leaving out the trials of roughness saves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from gsbake.geometry.raycast import RayCaster
from gsbake.materials.initialisation import TRIAL_PIXELS, TRIAL_STEPS, TRIALS, trial_cost
from gsbake.texturing.needed import SHARED, STEADY, TIED, constant_exposure, normals_agree
from gsbake.texturing.normal_map import find_detail, vertex_normals


@pytest.mark.parametrize(("gain", "steady"), [(1.0, True), (STEADY - 0.02, True), (STEADY + 0.02, False), (1 / (STEADY + 0.02), False)])
def test_exposure_is_constant_up_to_what_view_dependence_shows(gain: float, steady: bool) -> None:
    gains = np.ones((5, 3))
    gains[2, 1] = gain
    holds, evidence = constant_exposure(gains, 0.5)
    assert holds is steady and f"{max(gain, 1 / gain):.2f}x" in evidence


@pytest.mark.parametrize(("tied", "steady"), [(TIED - 0.02, True), (TIED + 0.02, False), (None, False)])
def test_tie_points_have_the_last_word_on_shining_things(tied: float | None, steady: bool) -> None:
    gains = np.ones((5, 3))
    gains[3] = 1.6
    assert constant_exposure(gains, 0.5, tied)[0] is steady
    assert constant_exposure(np.ones((5, 3)), 0.5, tied)[0]


@pytest.mark.parametrize(("explained", "steady"), [(SHARED - 0.02, True), (SHARED + 0.02, False)])
def test_gains_that_explain_little_are_reflections(explained: float, steady: bool) -> None:
    gains = np.ones((5, 3))
    gains[3] = 1.6
    holds, evidence = constant_exposure(gains, explained)
    assert holds is steady and f"{100 * explained:.0f} % of their differences" in evidence


def agreement(light: int, ripple: float) -> tuple[bool, str]:
    """The verdict on a sphere of `light` subdivisions against a fine one with ripples of the given height."""
    coarse, fine = trimesh.creation.icosphere(subdivisions=light), trimesh.creation.icosphere(subdivisions=5)
    raised = fine.vertices * (1 + ripple * np.sin(12 * fine.vertices[:, :1]))
    dense = RayCaster(raised, fine.faces, 1)
    points, faces = trimesh.sample.sample_surface(coarse, 4000, seed=0)
    share = trimesh.triangles.points_to_barycentric(coarse.triangles[faces], points)
    normal = (vertex_normals(coarse.vertices, coarse.faces)[coarse.faces[faces]] * share[:, :, None]).sum(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normals_agree(find_detail(points, normal, dense, vertex_normals(raised, fine.faces), 2 * np.sqrt(3)), normal)


def test_a_mesh_with_the_dense_normals_needs_no_map() -> None:
    holds, evidence = agreement(4, 0.0)
    assert holds and "95 %" in evidence


@pytest.mark.parametrize(("light", "ripple"), [(4, 0.01), (2, 0.006)])
def test_ripples_need_a_map(light: int, ripple: float) -> None:
    assert not agreement(light, ripple)[0]


def test_a_dense_surface_elsewhere_gives_no_map() -> None:
    away = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    dense = RayCaster(away.vertices + [5.0, 0, 0], away.faces, 1)
    normal = np.tile([0.0, 0, 1], (4, 1))
    detail = find_detail(np.zeros((4, 3)), normal, dense, vertex_normals(dense.vertices, dense.faces), 2.0)
    holds, evidence = normals_agree(detail, normal)
    assert holds and "nowhere" in evidence


def test_trials_cost_their_steps_at_the_share_of_pixels_they_shade() -> None:
    photos: Any = [range(2 * TRIAL_PIXELS)] * 10
    assert trial_cost(photos, 0.2) == pytest.approx(len(TRIALS) * TRIAL_STEPS * 0.2 / 2)
    assert trial_cost([range(10)] * 10, 0.2) == pytest.approx(len(TRIALS) * TRIAL_STEPS * 0.2)  # type: ignore[list-item]
    assert trial_cost(photos[:2], 0.2) == 0  # too few photos for trials
