"""The analytic scene: distances against closed forms, the Lipschitz bound, normals, materials."""

from __future__ import annotations

import numpy as np
from numpy.random import default_rng

from gsbake.synth import scene

OX, OY, _ = scene.ORIGIN


def around(count: int, seed: int = 0) -> np.ndarray:
    return np.array(scene.CENTRE) + default_rng(seed).uniform(-0.9, 0.9, (count, 3))


def test_distances_on_the_axes() -> None:
    # Computed by hand from the shape: jar radius .40, z .12–.92; bowl: ball of radius .36 about z = 1.10; foot radius .30, z 0–.16;
    # handle: ring of radius .22 about (.40, ·, .52), .04 thick.
    points = np.array(
        [
            [OX - 1.40, OY, 0.52],  # 1 from the side
            [OX, OY, 1.10],  # the bowl's centre
            [OX, OY, 0.74],  # the bowl's deepest point
            [OX, OY, 0.00],  # the underside
            [OX, OY, -0.30],
            [OX + 0.40 + 0.22, OY, 0.52],  # on the handle's core
            [OX + 0.40 + 0.22, OY + 0.10, 0.52],  # beside it
            [OX + 0.50, OY, 0.52],  # in the hole of the handle, .10 from the jar and .08 from the handle
        ]
    )
    expected = np.array([1.0, 0.36, 0.0, 0.0, 0.30, -0.04, 0.06, 0.08])
    np.testing.assert_allclose(scene.distances(points), expected, atol=1e-12)


def test_field_is_one_lipschitz() -> None:
    a = around(20_000)
    b = a + default_rng(1).normal(0, 0.1, a.shape)
    slope = np.abs(scene.distances(a) - scene.distances(b)) / np.linalg.norm(a - b, axis=1)
    assert slope.max() <= 1 + 1e-9
    assert slope.max() > 0.9  # and no shrunken field


def test_gradient_has_unit_length_outside() -> None:
    points = around(5000)
    points = points[scene.distances(points) > 0.01]
    h = 1e-6
    steps = [(scene.distances(points + h * e) - scene.distances(points - h * e)) / (2 * h) for e in np.eye(3)]
    lengths = np.linalg.norm(np.stack(steps, 1), axis=1)
    assert np.mean(np.abs(lengths - 1) < 1e-6) > 0.98  # the rest lies on creases
    np.testing.assert_allclose(np.median(np.sum(np.stack(steps, 1) * scene.normals(points), 1)), 1, atol=1e-6)


def test_the_bounding_sphere_contains_the_object() -> None:
    directions = default_rng(2).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shell = np.array(scene.CENTRE) + scene.RADIUS * directions
    assert scene.distances(shell).min() > 0


def test_trace_hits_where_the_closed_form_says() -> None:
    hit = scene.trace(OX - 3, OY, 0.52, 1.0, 0.0, 0.0, 0.0, 1e-6)
    assert abs(hit - 2.6) < 1e-5
    # Through the handle's hole, parallel to y: the ray must pass.
    assert scene.trace(OX + 0.50, OY - 3, 0.52, 0.0, 1.0, 0.0, 0.0, 1e-6) == -1
    # Down the axis: into the bowl, not onto its edge.
    assert abs(scene.trace(OX, OY, 3.0, 0.0, 0.0, -1.0, 0.0, 1e-6) - (3.0 - 0.74)) < 1e-5


def test_materials_are_four_and_physical() -> None:
    points = around(4000)
    surface = scene.materials(points)
    metal = scene.materials(np.array([[OX + 0.66, OY, 0.52], [OX, OY, 0.0]]))
    assert np.all(metal[:, 4] == 1)
    assert set(np.unique(surface[:, 4])) == {0.0, 1.0}
    assert surface[:, :3].min() > 0.01 and surface[:, :3].max() < 0.95
    glaze, emitter = scene.materials(np.array([[OX, OY - 0.40, 0.25], [OX - 0.40, OY + 0.05, 0.66]]))
    np.testing.assert_allclose(glaze, [*scene.GLAZE_ALBEDO, scene.GLAZE_ROUGHNESS, 0])
    assert emitter[:3].max() < 0.05 and emitter[4] == 0
    diffuse = surface[surface[:, 3] == 0.75]
    assert np.all(diffuse[:, 4] == 0)
    assert diffuse[:, :3].std(axis=0).min() > 0.08  # textured enough to find features on


def test_the_emissive_patch_has_its_radius_and_lights_no_other_point() -> None:
    angle, height = np.meshgrid(np.linspace(-np.pi, np.pi, 721), np.linspace(0.40, 0.90, 251))
    side = np.column_stack([OX + 0.4 * np.cos(angle.ravel()), OY + 0.4 * np.sin(angle.ravel()), height.ravel()])
    lit = scene.emissions(side).max(1) > 0
    area = lit.mean() * 2 * np.pi * 0.4 * 0.5
    np.testing.assert_allclose(area, np.pi * scene.EMITTER_RADIUS**2, rtol=0.03)  # the side turns away from the disc a little
    assert scene.emissions(np.array([[OX + 0.40, OY, 0.66]])).max() == 0
    # All of the object lies behind the tangent planes at the emissive points.
    for point in side[lit][::40]:
        outward = np.array([point[0] - OX, point[1] - OY, 0]) / 0.4
        surface = around(4000)
        surface = surface[np.abs(scene.distances(surface)) < 0.02]
        assert ((surface - point) @ outward).max() < 0.03


def test_noise_is_smooth_and_aperiodic() -> None:
    points = default_rng(3).uniform(-8, 8, (500, 3))
    values = np.array([scene.noise(*p) for p in points])
    assert values.min() >= 0 and values.max() <= 1 and values.std() > 0.1
    near = np.array([scene.noise(*(p + 1e-4)) for p in points])
    assert np.abs(values - near).max() < 1e-3
    shifted = np.array([scene.noise(p[0] + 1, p[1], p[2]) for p in points])
    assert abs(np.corrcoef(values, shifted)[0, 1]) < 0.4
