"""The photometric polish: the kernel against its twin; spheres of known size with texture, without, and as mirrors."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera
from gsbake.meshing.refinement.normals import edges_of, vertex_normals
from gsbake.meshing.refinement.photometric import SETTLED, Agreed, agree, gains
from gsbake.meshing.refinement.photometric_kernel import displace
from gsbake.meshing.refinement.photometric_measure import BELIEVED, Capture, Plan, Samples, measure, patch_means
from gsbake.meshing.refinement.photometric_reference import displacement
from gsbake.mvs.ncc import Pattern
from gsbake.mvs.pyramids import Pair, Photo
from tests.mvs.scenes import RADIUS, arc, photo, sphere_depth, texture

#: Size of a pixel on the part of the sphere that faces a camera.
PIXEL = (3 - RADIUS) / 330
#: Degrees between neighbouring cameras of the ring.
BETWEEN = 12.0


def mirror(camera: Camera) -> Photo:
    """The sphere as a perfect mirror of far surroundings."""
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
    """With the noise of a camera, 1.2 grey levels."""
    noise = np.random.default_rng(seed).normal(0, 1.2, made.grey.shape)
    return Photo(made.camera, np.clip(np.round(made.grey + noise), 0, 255).astype(np.uint8), made.inside)


@lru_cache(maxsize=3)
def capture(kind: str) -> Capture:
    """A ring of photos, with true depths that stereo is fully sure of: what must hold the polish back is in the photos."""
    cameras = arc(30, BETWEEN)
    depths = [sphere_depth(camera).astype(np.float32) for camera in cameras]
    photos = [noisy(KINDS[kind](camera), seed) for seed, camera in enumerate(cameras)]
    sure = np.ones_like(depths[0])
    return Capture(cameras, lambda i: photos[i], lambda i: (depths[i], sure), 4 * PIXEL)


def sphere(error: float) -> tuple[Array, NDArray[np.int32], NDArray[np.bool_]]:
    """Vertices and faces of a sphere `error` pixels too large, with dents of half as much; the vertices that the ring sees well."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    way = np.asarray(ball.vertices)
    dents = np.sin(7 * way[:, 0]) * np.sin(6 * way[:, 1] + 1) * np.cos(8 * way[:, 2])
    vertices = way * (RADIUS + error * PIXEL * (1 + 0.5 * dents))[:, None]
    return vertices, np.asarray(ball.faces, np.int32), np.abs(way[:, 2]) < 0.6


def polished(kind: str, error: float) -> tuple[Agreed, Array]:
    """The result, and the error in pixels left at the vertices that the ring sees well."""
    vertices, faces, seen = sphere(error)
    result = agree(vertices, faces, capture(kind), 3, 1)
    return result, (np.linalg.norm(result.vertices, axis=1)[seen] - RADIUS) / PIXEL


def test_kernel_is_its_twin() -> None:
    cameras = arc(6)
    photos = [noisy(photo(camera, sphere_depth(camera)), seed) for seed, camera in enumerate(cameras)]
    first, others = photos[2], [*photos[:2], *photos[3:]]
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(200, 3)) * 0.4 + first.camera.centre / 3
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * RADIUS + rng.normal(size=(200, 3)) * PIXEL
    pair, pattern, camera = Pair.of(first, others), Pattern.make(), first.camera
    shift, bend, cost = (np.empty(200, np.float32) for _ in range(3))
    displace(
        0, 200, (points @ camera.R.T + camera.t).astype(np.float32), (normals @ camera.R.T).astype(np.float32), np.full(200, 31),
        np.full(200, PIXEL, np.float32), pair.grey, pair.inside, pair.lens, (pattern.du, pattern.dv, pattern.near, pattern.alike),
        (pair.lenses, pair.packed, pair.starts, pair.sizes), 3, shift, bend, cost,
    )  # fmt: skip
    compared = 0
    for k in range(200):
        truth = displacement(first, others, points[k], normals[k], PIXEL, 3)
        if truth is None:
            assert bend[k] == 0
        elif bend[k] > 1e-3:  # below, single precision decides where the parabola's lowest place is
            compared += 1
            assert (bend[k], cost[k]) == pytest.approx(truth[1:], rel=5e-3, abs=1e-4)
            assert shift[k] == pytest.approx(truth[0], abs=0.02 * PIXEL + 0.02 * abs(truth[0]))
    assert compared > 100


def test_patch_means_of_a_sphere_lie_below_it() -> None:
    """Places at mean squared distance q lie q / 2R lower in the mean, to second order."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    vertices = np.asarray(ball.vertices)
    found = patch_means(vertices, edges_of(ball.faces), 0.04)
    assert 2 - np.linalg.norm(found, axis=1).mean() == pytest.approx(0.04 / (2 * 2), rel=0.1)


def test_measurements_know_how_far_away_the_sphere_is() -> None:
    vertices, faces, _ = sphere(0.0)
    grown, looked = vertices * (1 + PIXEL / RADIUS), capture("textured")
    plan = Plan.make(grown, faces, looked.cameras)
    samples = measure(grown, plan, looked, 1)
    used = samples.weights() > 0
    assert used.mean() > 0.5
    assert np.average(samples.shift[used], weights=samples.weights()[used]) == pytest.approx(-PIXEL, rel=0.15)
    assert np.abs(samples.shift[used]).max() <= BELIEVED * 2 * PIXEL  # steps are pixels where the point is, up to twice as far


def test_majority_decides() -> None:
    """Three useful of four: half the weight; two of four: none."""
    information = np.array([2.0, 2, 2, 0, 1, 1, 0, 0])
    samples = Samples(np.arange(8), np.repeat([3, 5], 4), np.zeros(8), information, np.ones(8))
    np.testing.assert_allclose(samples.weights(), [1, 1, 1, 0, 0, 0, 0, 0])


def test_a_round_gains_where_most_measurements_match_better() -> None:
    """A few patches that slip off an edge lose more than all the others gain; without those, losing is losing."""

    def found(ncc: list[float]) -> Samples:
        return Samples(np.arange(5), np.full(5, 2), np.zeros(5), np.ones(5), np.array(ncc))

    before = found([0.8, 0.8, 0.8, 0.8, 0.8])
    assert gains(before, found([0.81, 0.81, 0.81, 0.5, 0.5]))
    assert not gains(before, found([0.79, 0.79, 0.79, 0.99, 0.99]))
    assert not gains(before, before)
    useless = Samples(np.arange(5), np.full(5, 2), np.zeros(5), np.zeros(5), np.full(5, 0.8))
    assert not gains(useless, before)


@pytest.mark.parametrize("error", [1.0, -1.0])
def test_textured_sphere_comes_back(error: float) -> None:
    result, left = polished("textured", error)
    # Patches match to a tenth of a pixel or better; photos BETWEEN apart make that 0.1 / sin(BETWEEN) of depth.
    precision = 0.1 / np.sin(np.radians(BETWEEN))
    assert np.sqrt((left**2).mean()) < precision < 0.5 * abs(error)
    assert abs(left.mean()) < 0.25 * precision
    assert result.rounds >= 1
    assert result.after > result.before + 0.02


def test_true_sphere_stays() -> None:
    result, left = polished("textured", 0.0)
    assert result.share > 0.5
    assert np.sqrt((left**2).mean()) < SETTLED


@pytest.mark.parametrize(("kind", "error"), [("plain", 0.0), ("plain", 1.0), ("mirror", 0.0), ("mirror", 1.0)])
def test_plain_and_mirroring_spheres_stay(kind: str, error: float) -> None:
    """Grey alone tells nothing; what a mirror shows tells nothing about where it is."""
    vertices, _, seen = sphere(error)
    result, _ = polished(kind, error)
    moved = np.linalg.norm(result.vertices - vertices, axis=1)[seen] / PIXEL
    assert np.median(moved) < 0.02
    assert moved.max() < 0.2


def test_nothing_moves_without_stereo() -> None:
    vertices, faces, _ = sphere(1.0)
    looked = capture("textured")
    result = agree(vertices, faces, Capture(looked.cameras, looked.photo, lambda i: None, looked.tolerance), 2, 1)
    np.testing.assert_array_equal(result.vertices, vertices)
    assert (result.rounds, result.share, result.move) == (0, 0, 0)


def test_vertices_move_along_their_normals() -> None:
    vertices, faces, seen = sphere(1.0)
    result = agree(vertices, faces, capture("textured"), 1, 1)
    step = result.vertices - vertices
    length = np.linalg.norm(step, axis=1)
    along = np.abs((step * vertex_normals(vertices, faces)).sum(1))
    np.testing.assert_allclose(along[seen], length[seen], atol=1e-12)
    assert np.median(length[seen]) > 0.3 * PIXEL
