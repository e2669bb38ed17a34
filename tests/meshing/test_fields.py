"""The lattice, marching cubes, the filling, IMLS, normals and resolution against analytic answers."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.meshing import cleanup as clean
from gsbake.meshing.depth_views import DepthView, depth_noise, outside_distance
from gsbake.meshing.hole_filling import crossing_blocks, diffuse, span
from gsbake.meshing.imls import imls_field
from gsbake.meshing.marching_cubes import march
from gsbake.meshing.refinement.normals import NormalGather, follow_normals, vertex_normals
from gsbake.meshing.resolution import choose, pixel_footprint, surfel_spacing
from gsbake.meshing.sparse_lattice import EDGE, BlockLattice
from tests.meshing.scenes import camera_at, cameras_around, gradient, sphere, torus, trace

CELL = 1 / 40


def even_points(shape, count: int = 6000) -> np.ndarray:
    """Points on the shape by projection along the gradient."""
    p = np.random.default_rng(0).uniform(-0.9, 0.9, (count, 3))
    for _ in range(12):
        p = p - shape(p)[:, None] * gradient(shape, p)
    return p[np.abs(shape(p)) < 1e-6]


def lattice_near(points: np.ndarray, cell: float = CELL) -> BlockLattice:
    lattice = BlockLattice([-1] * 3, [1] * 3, cell)
    wanted = np.zeros(lattice.shape, np.bool_)
    lattice.mark_near(points, 3 * cell, wanted)
    lattice.allocate(wanted)
    return lattice


def test_blocks_hold_what_was_asked_for() -> None:
    points = even_points(sphere, 500)
    lattice = lattice_near(points)
    assert 0 < len(lattice) < np.prod(lattice.shape)
    position = lattice.positions(slice(None))
    assert position.shape == (len(lattice), EDGE, EDGE, EDGE, 3)
    # Every sample within reach of a point is there.
    for point in points[:20]:
        base = np.floor((point - lattice.lower) / lattice.cell).astype(int)
        assert (lattice.index[tuple((base[:, None] + [-2, 3]) // EDGE)] >= 0).all()
    before = len(lattice)
    lattice.allocate(lattice.index >= 0)
    assert len(lattice) == before


def test_marching_cubes_is_welded_and_outward() -> None:
    lattice = lattice_near(even_points(sphere))
    values = np.clip(sphere(lattice.positions(slice(None)).astype(float)) / (3 * CELL), -1, 1).astype(np.float32)
    vertices, faces = march(lattice, values)
    assert clean.topology(vertices, faces) == clean.Topology(1, True, 0, 0)
    assert np.abs(sphere(vertices)).max() < 0.02 * CELL * 2
    corners = vertices[faces]
    volume = np.einsum("fd,fd->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.003)


def test_marching_cubes_leaves_the_unknown_open() -> None:
    lattice = lattice_near(even_points(sphere))
    position = lattice.positions(slice(None))
    values = np.clip(sphere(position.astype(float)) / (3 * CELL), -1, 1).astype(np.float32)
    values[position[..., 2] > 0] = np.nan
    vertices, faces = march(lattice, values)
    assert -2 * CELL < vertices[:, 2].max() <= 0
    assert np.abs(sphere(vertices)).max() < 0.1 * CELL  # no wall along the border of the known
    assert clean.topology(vertices, faces).components == 1
    assert march(lattice, np.full_like(values, np.nan))[1].shape == (0, 3)


def test_diffusion_solves_laplace() -> None:
    lattice = BlockLattice([0] * 3, [1.4] * 3, 0.1)
    lattice.allocate_all()
    position = lattice.positions(slice(None)).astype(float)
    x, y, z = np.moveaxis(position, -1, 0)
    exact = (x * x - y * y + 0.5 * z * x).astype(np.float32)  # harmonic
    whole = np.rint(position / 0.1).astype(int)
    unknown = ((whole > 0) & (whole < np.array(lattice.samples) - 1)).all(-1)
    values = np.where(unknown, 0, exact).astype(np.float32)
    diffuse(lattice, values, unknown, 60, 1.7)
    np.testing.assert_allclose(values, exact, atol=2e-4)


def test_span_draws_a_flat_film() -> None:
    """Known: a tube's wall inside, empty below and around; the film across the tube's mouth must be flat, not a bowl."""
    lattice = BlockLattice([-1] * 3, [0.99] * 3, 2 / 31)
    lattice.allocate_all()
    x, y, z = np.moveaxis(lattice.positions(slice(None)).astype(float), -1, 0)
    r = np.hypot(x, y)
    values = np.zeros(r.shape, np.float32)
    wall, empty = (np.abs(r - 0.6) < 0.08) & (z > 0), (r > 0.68) | (z < -0.5 + 0.3 * r)
    values[empty], values[wall] = 1, -1
    unknown = ~(wall | empty)
    diffuse(lattice, values, unknown, 40, 1.8)

    def film() -> np.ndarray:
        vertices, _ = march(lattice, values)
        return vertices[np.hypot(vertices[:, 0], vertices[:, 1]) < 0.4][:, 2]

    bowl = np.ptp(film())
    span(lattice, values, unknown, crossing_blocks(lattice, values, unknown), 10, 1.8, 10)
    flat = film()
    assert np.ptp(flat) < 0.6 * bowl
    assert abs(flat.mean()) < 2 * lattice.cell


@pytest.mark.parametrize("shape", [sphere, torus])
def test_imls_of_noisy_samples(shape) -> None:
    points = even_points(shape)
    normals = gradient(shape, points)
    rng = np.random.default_rng(2)
    noisy = points + 0.15 * CELL * rng.normal(size=points.shape)
    lattice = lattice_near(points)
    vertices, faces = march(lattice, imls_field(lattice, noisy, normals, 4 * CELL))
    assert np.abs(shape(vertices)).mean() < 0.15 * CELL
    assert clean.topology(vertices, faces).components == 1
    assert ((vertex_normals(vertices, faces) * gradient(shape, vertices)).sum(1) > 0.9).mean() > 0.99


def test_imls_robust_pass_ignores_outliers() -> None:
    points = even_points(sphere)
    normals = gradient(sphere, points)
    bad = np.arange(0, len(points), 10)
    points[bad] += 1.5 * CELL * normals[bad]
    lattice = lattice_near(points)
    off = [np.abs(sphere(march(lattice, imls_field(lattice, points, normals, 4 * CELL, robust=r))[0])).mean() for r in (False, True)]
    assert off[1] < 0.85 * off[0]


def test_normals_undo_bumps() -> None:
    """Depth with bumps, normals without: the moved vertices must come closer to the truth in both."""
    views = [(camera, *trace(sphere, camera)) for camera in cameras_around((-40, 0, 40), 6, 120)]
    lattice = lattice_near(even_points(sphere))
    position = lattice.positions(slice(None)).astype(float)
    bumps = 0.4 * CELL * np.sin(position * (2 * np.pi / (5 * CELL))).sum(-1)
    vertices, faces = march(lattice, np.clip((sphere(position) + bumps) / (3 * CELL), -1, 1).astype(np.float32))
    gather = NormalGather(vertices, 3 * CELL)
    for camera, depth, normal, cosine in views:
        gather.add(DepthView.of(camera, depth, cosine, cosine), normal)
    target, trust = gather.normals()
    assert (trust > 0.9).mean() > 0.9
    moved = follow_normals(vertices, faces, target, trust, reach=15 * CELL, limit=2 * CELL)

    def angle(v: np.ndarray) -> float:
        return float(np.degrees(np.arccos(np.clip((vertex_normals(v, faces) * gradient(sphere, v)).sum(1), -1, 1))).mean())

    assert angle(moved) < 0.35 * angle(vertices)
    # A wave as long as the reach is halved.
    half = follow_normals(vertices, faces, target, trust, reach=5 * CELL, limit=2 * CELL)
    assert angle(half) == pytest.approx(0.5 * angle(vertices), rel=0.25)
    assert np.abs(sphere(moved)).mean() < 0.6 * np.abs(sphere(vertices)).mean()
    assert abs(sphere(moved).mean()) < 0.05 * CELL
    np.testing.assert_array_equal(follow_normals(vertices, faces, target, trust, 0.0, 1.0), vertices)


def test_outside_distance_counts_from_the_edge() -> None:
    mask = np.zeros((5, 9), np.uint8)
    mask[:, :3] = 255
    distance = outside_distance(mask, margin=0.0)
    np.testing.assert_allclose(distance[2], [0, 0, 0, 0.5, 1.5, 2.5, 3.5, 4.5, 5.5])
    assert (outside_distance(np.zeros_like(mask)) > 0).all() and not outside_distance(np.full_like(mask, 255)).any()


def test_depth_noise_is_measured() -> None:
    a, b = cameras_around((20,), 24, 120)[:2]
    rng = np.random.default_rng(5)
    views = []
    for camera in (a, b):
        depth, _, _ = trace(sphere, camera)
        views.append(DepthView.of(camera, np.where(depth > 0, depth + 0.01 * rng.normal(size=depth.shape), 0).astype(np.float32)))
    # The difference of two normal errors of 0.01 has a median magnitude of 0.6745 · √2 · 0.01; pixel steps add a little.
    assert depth_noise(*views, stride=1) == pytest.approx(0.0095, rel=0.25)


def test_flying_pixels_and_thin_foreground() -> None:
    camera = camera_at(np.array([3.0, 0, 0]), "c", 60)
    shape = (camera.height, camera.width)
    depth = np.full(shape, 3.0, np.float32)
    depth[:, 20:22] = 2.0  # a thin part before the rest: two pixels wide, kept
    normal = np.broadcast_to(-camera.view_direction, (*shape, 3)).astype(np.float32)
    buffers = {"depth": depth, "median_depth": depth, "normal": normal, "alpha": np.ones(shape, np.float32)}
    view = DepthView.from_gbuffer(camera, buffers, None, 0.1)
    assert (view.inverse[5:45, 20:22] > 0).all()
    mixed = depth.copy()
    mixed[::2, 30] = 2.5  # single pixels that are neither near nor far
    lone = DepthView.from_gbuffer(camera, dict(buffers, depth=mixed, median_depth=mixed), None, 0.1)
    assert not lone.inverse[::2, 30].any() and (lone.inverse[1:-1:2, 30] > 0).all()
    low = dict(buffers, alpha=np.full(shape, 0.4, np.float32))
    assert not DepthView.from_gbuffer(camera, low, None, 0.1).inverse.any()


def test_resolution_follows_the_evidence() -> None:
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(60), [0]), -1).reshape(-1, 3) * 0.02
    assert surfel_spacing(grid) == pytest.approx(0.02, rel=0.15)
    cameras = [camera_at(np.array([3.0, 0, 0]), "c", 160)]
    assert pixel_footprint(cameras, np.zeros(3)) == pytest.approx(3 / (160 * 1.2))
    assert choose(2.0, 0.02, 0.001, 0, 384).cells == 150
    assert choose(2.0, 0.002, 0.02, 0, 384).cells == 134
    bounded = choose(2.0, 0.001, 0.001, 0, 384)
    assert bounded.cells == 384 and "bounded" in bounded.reason
    assert choose(2.0, 0.02, 0.001, 100, 384).cell == pytest.approx(0.02)
