"""Lattice, marching cubes, hole filling, IMLS, normals and resolution against analytic results."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.geometry.sparse_lattice import EDGE, BlockLattice
from gsbake.meshing import cleanup as clean
from gsbake.meshing.depth_views import DepthView, depth_noise, distance_outside_mask
from gsbake.meshing.hole_filling import minimise_area, sign_change_blocks, solve_laplace
from gsbake.meshing.marching_cubes import extract_isosurface
from gsbake.meshing.refinement.normals import NormalAccumulator, integrate_normals
from gsbake.meshing.resolution import choose_resolution, pixel_footprint
from gsbake.shape_refinement.surface import Surface
from gsbake.surfels.fields.imls import imls_field
from gsbake.surfels.spacing import surfel_spacing
from tests.meshing.scenes import camera_at, cameras_around, gradient, sphere, torus, trace

CELL = 1 / 40


def even_points(shape, count: int = 6000) -> np.ndarray:
    """Points on the shape, by projection along the gradient."""
    p = np.random.default_rng(0).uniform(-0.9, 0.9, (count, 3))
    for _ in range(12):
        p = p - shape(p)[:, None] * gradient(shape, p)
    return p[np.abs(shape(p)) < 1e-6]


def lattice_near(points: np.ndarray, cell: float = CELL) -> BlockLattice:
    lattice = BlockLattice([-1] * 3, [1] * 3, cell)
    wanted = np.zeros(lattice.shape, np.bool_)
    lattice.mark_blocks_near(points, 3 * cell, wanted)
    lattice.allocate(wanted)
    return lattice


def test_marked_blocks_are_allocated() -> None:
    points = even_points(sphere, 500)
    lattice = lattice_near(points)
    assert 0 < len(lattice) < np.prod(lattice.shape)
    position = lattice.positions(slice(None))
    assert position.shape == (len(lattice), EDGE, EDGE, EDGE, 3)
    # Every sample within the radius of a point is allocated.
    for point in points[:20]:
        base = np.floor((point - lattice.lower) / lattice.cell).astype(int)
        assert (lattice.index[tuple((base[:, None] + [-2, 3]) // EDGE)] >= 0).all()
    before = len(lattice)
    lattice.allocate(lattice.index >= 0)
    assert len(lattice) == before


def test_marching_cubes_is_welded_and_outward() -> None:
    lattice = lattice_near(even_points(sphere))
    values = np.clip(sphere(lattice.positions(slice(None)).astype(float)) / (3 * CELL), -1, 1).astype(np.float32)
    vertices, faces = extract_isosurface(lattice, values)
    assert clean.topology(vertices, faces) == clean.Topology(1, True, 0, 0)
    assert np.abs(sphere(vertices)).max() < 0.02 * CELL * 2
    corners = vertices[faces]
    volume = np.einsum("fd,fd->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.003)


def test_marching_cubes_is_open_at_unknown_samples() -> None:
    lattice = lattice_near(even_points(sphere))
    position = lattice.positions(slice(None))
    values = np.clip(sphere(position.astype(float)) / (3 * CELL), -1, 1).astype(np.float32)
    values[position[..., 2] > 0] = np.nan
    vertices, faces = extract_isosurface(lattice, values)
    assert -2 * CELL < vertices[:, 2].max() <= 0
    assert np.abs(sphere(vertices)).max() < 0.1 * CELL  # no wall along the boundary of the known samples
    assert clean.topology(vertices, faces).components == 1
    assert extract_isosurface(lattice, np.full_like(values, np.nan))[1].shape == (0, 3)


def test_diffusion_solves_laplace() -> None:
    lattice = BlockLattice([0] * 3, [1.4] * 3, 0.1)
    lattice.allocate_all()
    position = lattice.positions(slice(None)).astype(float)
    x, y, z = np.moveaxis(position, -1, 0)
    exact = (x * x - y * y + 0.5 * z * x).astype(np.float32)  # harmonic
    whole = np.rint(position / 0.1).astype(int)
    unknown = ((whole > 0) & (whole < np.array(lattice.samples) - 1)).all(-1)
    values = np.where(unknown, 0, exact).astype(np.float32)
    solve_laplace(lattice, values, unknown, 60, 1.7)
    np.testing.assert_allclose(values, exact, atol=2e-4)


def test_minimal_surface_is_flat() -> None:
    """Known: inside a tube's wall, free space below and around; the surface across its opening must be flat, not a bowl."""
    lattice = BlockLattice([-1] * 3, [0.99] * 3, 2 / 31)
    lattice.allocate_all()
    x, y, z = np.moveaxis(lattice.positions(slice(None)).astype(float), -1, 0)
    r = np.hypot(x, y)
    values = np.zeros(r.shape, np.float32)
    wall, empty = (np.abs(r - 0.6) < 0.08) & (z > 0), (r > 0.68) | (z < -0.5 + 0.3 * r)
    values[empty], values[wall] = 1, -1
    unknown = ~(wall | empty)
    solve_laplace(lattice, values, unknown, 40, 1.8)

    def film() -> np.ndarray:
        vertices, _ = extract_isosurface(lattice, values)
        return vertices[np.hypot(vertices[:, 0], vertices[:, 1]) < 0.4][:, 2]

    bowl = np.ptp(film())
    minimise_area(lattice, values, unknown, sign_change_blocks(lattice, values, unknown), 10, 1.8, 10)
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
    vertices, faces = extract_isosurface(lattice, imls_field(lattice, noisy, normals, 4 * CELL))
    assert np.abs(shape(vertices)).mean() < 0.15 * CELL
    assert clean.topology(vertices, faces).components == 1
    assert ((Surface(len(vertices), faces).normals(vertices) * gradient(shape, vertices)).sum(1) > 0.9).mean() > 0.99


def test_imls_robust_pass_ignores_outliers() -> None:
    points = even_points(sphere)
    normals = gradient(sphere, points)
    bad = np.arange(0, len(points), 10)
    points[bad] += 1.5 * CELL * normals[bad]
    lattice = lattice_near(points)
    errors = [
        np.abs(sphere(extract_isosurface(lattice, imls_field(lattice, points, normals, 4 * CELL, robust=r))[0])).mean()
        for r in (False, True)
    ]
    assert errors[1] < 0.85 * errors[0]


def test_normal_integration_removes_bumps() -> None:
    """Positions with bumps, normals without: the refined vertices must be closer to the truth in both."""
    views = [(camera, *trace(sphere, camera)) for camera in cameras_around((-40, 0, 40), 6, 120)]
    lattice = lattice_near(even_points(sphere))
    position = lattice.positions(slice(None)).astype(float)
    bumps = 0.4 * CELL * np.sin(position * (2 * np.pi / (5 * CELL))).sum(-1)
    vertices, faces = extract_isosurface(lattice, np.clip((sphere(position) + bumps) / (3 * CELL), -1, 1).astype(np.float32))
    accumulator = NormalAccumulator(vertices, 3 * CELL)
    for camera, depth, normal, cosine in views:
        accumulator.add(DepthView.from_depth(camera, depth, cosine, cosine), normal)
    target, confidence = accumulator.normals()
    assert (confidence > 0.9).mean() > 0.9
    moved = integrate_normals(vertices, faces, target, confidence, wavelength=15 * CELL, max_displacement=2 * CELL)

    def angle(v: np.ndarray) -> float:
        return float(np.degrees(np.arccos(np.clip((Surface(len(v), faces).normals(v) * gradient(sphere, v)).sum(1), -1, 1))).mean())

    assert angle(moved) < 0.35 * angle(vertices)
    # A wave of the wavelength itself is halved.
    half = integrate_normals(vertices, faces, target, confidence, wavelength=5 * CELL, max_displacement=2 * CELL)
    assert angle(half) == pytest.approx(0.5 * angle(vertices), rel=0.25)
    assert np.abs(sphere(moved)).mean() < 0.6 * np.abs(sphere(vertices)).mean()
    assert abs(sphere(moved).mean()) < 0.05 * CELL
    np.testing.assert_array_equal(integrate_normals(vertices, faces, target, confidence, 0.0, 1.0), vertices)


def test_distance_outside_mask_starts_at_the_boundary() -> None:
    mask = np.zeros((5, 9), np.uint8)
    mask[:, :3] = 255
    distance = distance_outside_mask(mask, margin=0.0)
    np.testing.assert_allclose(distance[2], [0, 0, 0, 0.5, 1.5, 2.5, 3.5, 4.5, 5.5])
    assert (distance_outside_mask(np.zeros_like(mask)) > 0).all() and not distance_outside_mask(np.full_like(mask, 255)).any()


def test_depth_noise_is_measured() -> None:
    a, b = cameras_around((20,), 24, 120)[:2]
    rng = np.random.default_rng(5)
    views = []
    for camera in (a, b):
        depth, _, _ = trace(sphere, camera)
        views.append(DepthView.from_depth(camera, np.where(depth > 0, depth + 0.01 * rng.normal(size=depth.shape), 0).astype(np.float32)))
    # The difference of two normal errors of 0.01 has a median magnitude of 0.6745 · √2 · 0.01; pixel steps add a little.
    assert depth_noise(*views, stride=1) == pytest.approx(0.0095, rel=0.25)


def test_flying_pixels_are_rejected_and_thin_foreground_is_kept() -> None:
    camera = camera_at(np.array([3.0, 0, 0]), "c", 60)
    shape = (camera.height, camera.width)
    depth = np.full(shape, 3.0, np.float32)
    depth[:, 20:22] = 2.0  # a thin part in front, two pixels wide: kept
    normal = np.broadcast_to(-camera.view_direction, (*shape, 3)).astype(np.float32)
    buffers = {"depth": depth, "median_depth": depth, "normal": normal, "alpha": np.ones(shape, np.float32)}
    view = DepthView.from_gbuffer(camera, buffers, None, 0.1)
    assert (view.inverse[5:45, 20:22] > 0).all()
    mixed = depth.copy()
    mixed[::2, 30] = 2.5  # single pixels between the near and the far layer
    lone = DepthView.from_gbuffer(camera, dict(buffers, depth=mixed, median_depth=mixed), None, 0.1)
    assert not lone.inverse[::2, 30].any() and (lone.inverse[1:-1:2, 30] > 0).all()
    low = dict(buffers, alpha=np.full(shape, 0.4, np.float32))
    assert not DepthView.from_gbuffer(camera, low, None, 0.1).inverse.any()


def test_resolution_follows_spacing_and_footprint() -> None:
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(60), [0]), -1).reshape(-1, 3) * 0.02
    assert surfel_spacing(grid) == pytest.approx(0.02, rel=0.15)
    cameras = [camera_at(np.array([3.0, 0, 0]), "c", 160)]
    assert pixel_footprint(cameras, np.zeros(3)) == pytest.approx(3 / (160 * 1.2))
    assert choose_resolution(2.0, 0.02, 0.001, 0, 384).cells == 150
    assert choose_resolution(2.0, 0.002, 0.02, 0, 384).cells == 134
    bounded = choose_resolution(2.0, 0.001, 0.001, 0, 384)
    assert bounded.cells == 384 and "limited" in bounded.reason
    assert choose_resolution(2.0, 0.02, 0.001, 100, 384).cell == pytest.approx(0.02)
