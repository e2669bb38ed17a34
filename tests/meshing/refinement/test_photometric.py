"""Displacements from patches: kernel against reference; textured, untextured and mirroring spheres of known size."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera
from gsbake.meshing.refinement.photometric_kernel import measure_displacements
from gsbake.meshing.refinement.photometric_measure import (
    MAX_STEPS,
    MeasurementPlan,
    Measurements,
    PatchTargets,
    PhotometricViews,
    measure,
    patch_means,
)
from gsbake.meshing.refinement.photometric_reference import displacement_reference
from gsbake.mvs.ncc import SamplingPattern
from gsbake.mvs.pyramids import MatchingViews, Photo
from gsbake.shape_refinement.refine import RefinementOptions
from gsbake.shape_refinement.step import solve_step
from gsbake.shape_refinement.surface import Surface
from tests.mvs.scenes import RADIUS, arc, photo, sphere_depth, texture
from tests.support.slow import slow

#: Size of a pixel on the part of the sphere that faces a camera.
PIXEL = (3 - RADIUS) / 330
#: Degrees between neighbouring cameras of the ring.
BETWEEN = 12.0


def mirror(camera: Camera) -> Photo:
    """The sphere as a perfect mirror of a distant environment."""
    depth, rays = sphere_depth(camera), camera.rays()
    normal = (camera.centre + depth[..., None] * rays) / RADIUS
    away = rays - 2 * (rays * normal).sum(-1, keepdims=True) * normal
    seen = texture(away / np.linalg.norm(away, axis=-1, keepdims=True))
    return Photo(camera, np.where(depth > 0, seen, 128).round().astype(np.uint8), (depth > 0).astype(np.uint8))


KINDS: dict[str, Callable[[Camera], Photo]] = {
    "textured": lambda camera: photo(camera, sphere_depth(camera)),
    "plain": lambda camera: photo(camera, sphere_depth(camera), flat=True),
    "mirror": mirror,
}


def noisy(made: Photo, seed: int) -> Photo:
    """The photo with camera noise of 1.2 grey levels."""
    noise = np.random.default_rng(seed).normal(0, 1.2, made.grey.shape)
    return Photo(made.camera, np.clip(np.round(made.grey + noise), 0, 255).astype(np.uint8), made.inside)


@lru_cache(maxsize=3)
def capture(surface: str) -> PhotometricViews:
    """A ring of photos with true stereo depths of confidence 1: only the photos can prevent a displacement."""
    cameras = arc(30, BETWEEN)
    depths = [sphere_depth(camera).astype(np.float32) for camera in cameras]
    photos = [noisy(KINDS[surface](camera), seed) for seed, camera in enumerate(cameras)]
    sure = np.ones_like(depths[0])
    return PhotometricViews(cameras, lambda i: photos[i], lambda i: (depths[i], sure), 4 * PIXEL)


def sphere(error: float) -> tuple[Array, NDArray[np.int32], NDArray[np.bool_]]:
    """Vertices and faces of a sphere `error` pixels too large, with dents of half as much; mask of the well visible vertices."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    way = np.asarray(ball.vertices)
    dents = np.sin(7 * way[:, 0]) * np.sin(6 * way[:, 1] + 1) * np.cos(8 * way[:, 2])
    vertices = way * (RADIUS + error * PIXEL * (1 + 0.5 * dents))[:, None]
    return vertices, np.asarray(ball.faces, np.int32), np.abs(way[:, 2]) < 0.6


def refined(surface: str, error: float, steps: int = 5) -> tuple[Array, Array]:
    """The sphere after `steps` steps towards what the patches measure, and the remaining error in pixels at the well visible vertices."""
    vertices, faces, seen = sphere(error)
    mesh, patches = Surface(len(vertices), faces), PatchTargets(capture(surface), 1)
    for _ in range(steps):
        displacement = solve_step(mesh, vertices, PIXEL, [patches(mesh, vertices)[0]], RefinementOptions().first)
        vertices = vertices + displacement[:, None] * mesh.normals(vertices)
    return vertices, (np.linalg.norm(vertices, axis=1)[seen] - RADIUS) / PIXEL


def test_kernel_equals_the_reference() -> None:
    cameras = arc(6)
    photos = [noisy(photo(camera, sphere_depth(camera)), seed) for seed, camera in enumerate(cameras)]
    first, others = photos[2], [*photos[:2], *photos[3:]]
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(200, 3)) * 0.4 + first.camera.centre / 3
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * RADIUS + rng.normal(size=(200, 3)) * PIXEL
    pair, pattern, camera = MatchingViews.of(first, others), SamplingPattern.make(), first.camera
    displacement, curvature, cost = (np.empty(200, np.float32) for _ in range(3))
    measure_displacements(
        0, 200, (points @ camera.R.T + camera.t).astype(np.float32), (normals @ camera.R.T).astype(np.float32), np.full(200, 31),
        np.full(200, PIXEL, np.float32), pair.grey, pair.inside, pair.intrinsics, pattern.arrays,
        pair.sources, 3, displacement, curvature, cost,
    )  # fmt: skip
    compared = 0
    for k in range(200):
        truth = displacement_reference(first, others, points[k], normals[k], PIXEL, 3)
        if truth is None:
            assert curvature[k] == 0
        elif curvature[k] > 1e-3:  # below, single precision determines the parabola's minimum
            compared += 1
            assert (curvature[k], cost[k]) == pytest.approx(truth[1:], rel=5e-3, abs=1e-4)
            assert displacement[k] == pytest.approx(truth[0], abs=0.02 * PIXEL + 0.02 * abs(truth[0]))
    assert compared > 100


def test_patch_means_of_a_sphere_lie_below_its_surface() -> None:
    """The mean of a patch with variance q lies q / 2R below the surface, to second order."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    vertices = np.asarray(ball.vertices)
    found = patch_means(vertices, Surface(len(vertices), ball.faces), 0.04)
    assert 2 - np.linalg.norm(found, axis=1).mean() == pytest.approx(0.04 / (2 * 2), rel=0.1)


def test_measured_displacement_equals_the_true_one() -> None:
    vertices, faces, _ = sphere(0.0)
    grown, views = vertices * (1 + PIXEL / RADIUS), capture("textured")
    plan = MeasurementPlan.make(Surface(len(grown), faces), grown, views.cameras)
    samples = measure(grown, plan, views, 1)
    used = samples.weights() > 0
    assert used.mean() > 0.5
    assert np.average(samples.displacement[used], weights=samples.weights()[used]) == pytest.approx(-PIXEL, rel=0.15)
    assert np.abs(samples.displacement[used]).max() <= MAX_STEPS * 2 * PIXEL  # steps are pixels where the point is, up to twice as far


def test_weights_by_majority() -> None:
    """Three valid of four: half the weight; two of four: none."""
    information = np.array([2.0, 2, 2, 0, 1, 1, 0, 0])
    samples = Measurements(np.repeat([3, 5], 4), np.zeros(8), information)
    np.testing.assert_allclose(samples.weights(), [1, 1, 1, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("error", [1.0, slow(-1.0)])
def test_textured_sphere_is_recovered(error: float) -> None:
    _, left = refined("textured", error)
    # Patches match to a tenth of a pixel or better; photos BETWEEN apart make that 0.1 / sin(BETWEEN) of depth.
    precision = 0.1 / np.sin(np.radians(BETWEEN))
    assert np.sqrt((left**2).mean()) < precision < 0.5 * abs(error)
    assert abs(left.mean()) < 0.35 * precision


def test_true_sphere_is_unchanged() -> None:
    vertices, faces, _ = sphere(0.0)
    _, share = PatchTargets(capture("textured"), 1)(Surface(len(vertices), faces), vertices)
    assert share > 0.5
    assert np.sqrt((refined("textured", 0.0)[1] ** 2).mean()) < 0.2


@pytest.mark.parametrize(("surface", "error"), [slow("plain", 0.0), ("plain", 1.0), slow("mirror", 0.0), slow("mirror", 1.0)])
def test_untextured_and_mirroring_spheres_are_unchanged(surface: str, error: float) -> None:
    """Without texture there is no measurement; reflections are inconsistent between photos."""
    vertices, _, seen = sphere(error)
    found, _ = refined(surface, error)
    moved = np.linalg.norm(found - vertices, axis=1)[seen] / PIXEL
    assert np.median(moved) < 0.02
    assert moved.max() < 0.2


def test_nothing_is_measured_without_stereo_or_surface() -> None:
    vertices, faces, _ = sphere(1.0)
    views, surface = capture("textured"), Surface(len(vertices), faces)
    without = PhotometricViews(views.cameras, views.photo, lambda i: None, views.tolerance)
    for measured, at in ((without, vertices), (views, np.zeros_like(vertices))):
        targets, share = PatchTargets(measured, 1)(surface, at)
        assert (len(targets.target), share) == (0, 0)
