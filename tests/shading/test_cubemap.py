"""Cube-map geometry against the OpenGL table, closed forms and continuity."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsbake.geometry.vectors import unit
from gsbake.shading import cubemap, octahedral


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


@pytest.mark.parametrize(
    ("face", "centre", "growing_column", "growing_row"),
    [
        (0, (1, 0, 0), (0, 0, -1), (0, -1, 0)),
        (1, (-1, 0, 0), (0, 0, 1), (0, -1, 0)),
        (2, (0, 1, 0), (1, 0, 0), (0, 0, 1)),
        (3, (0, -1, 0), (1, 0, 0), (0, 0, -1)),
        (4, (0, 0, 1), (1, 0, 0), (0, -1, 0)),
        (5, (0, 0, -1), (-1, 0, 0), (0, -1, 0)),
    ],
)
def test_faces_follow_opengl(face: int, centre: tuple, growing_column: tuple, growing_row: tuple) -> None:
    dirs = cubemap.directions(5)[face]
    np.testing.assert_allclose(dirs[2, 2], centre, atol=1e-15)
    assert np.dot(dirs[2, 3] - dirs[2, 1], growing_column) > 0.3
    assert np.dot(dirs[3, 2] - dirs[1, 2], growing_row) > 0.3


@pytest.mark.parametrize("size", [1, 4, 7, 32])
def test_solid_angles(size: int) -> None:
    angles = cubemap.solid_angles(size)
    assert angles.sum() == pytest.approx(4 * math.pi, rel=1e-12)
    # Independent: the density of a cube's face is 1/r³; the midpoint rule on 64² points per texel.
    fine = (2 * np.arange(64 * size) + 1) / (64 * size) - 1
    density = (1 + fine[:, None] ** 2 + fine[None] ** 2) ** -1.5 * (2 / (64 * size)) ** 2
    np.testing.assert_allclose(angles[3], density.reshape(size, 64, size, 64).sum(axis=(1, 3)), rtol=1e-4)


def test_texel_inverts_directions() -> None:
    for size in (4, 5, 16):
        assert (cubemap.texel_index(size, 3.0 * cubemap.directions(size).reshape(-1, 3)) == np.arange(6 * size * size)).all()


@pytest.mark.parametrize("size", [4, 5, 16])
def test_sampling_reproduces_texels_and_linear_functions(size: int) -> None:
    dirs = cubemap.directions(size)
    noise = np.random.default_rng(1).random((6, size, size, 3))
    np.testing.assert_allclose(cubemap.sample(noise, dirs.reshape(-1, 3)), noise.reshape(-1, 3), atol=1e-12)
    probe = random_directions(500)
    # Bilinear interpolation of the smooth function "direction" errs by at most (texel width)² / 4 or so, seams and corners included.
    assert np.abs(cubemap.sample(dirs, probe) - probe).max() < (2.0 / size) ** 2


def test_sampling_is_continuous_over_edges_and_corners() -> None:
    noise = np.random.default_rng(2).random((6, 8, 8, 1))
    rng = np.random.default_rng(3)
    edge = rng.uniform(-1, 1, (400, 3))
    first = rng.integers(0, 3, 400)
    second = (first + rng.integers(1, 3, 400)) % 3
    rows = np.arange(400)
    edge[rows, first] = np.sign(edge[rows, first])
    edge[rows, second] = np.sign(edge[rows, second])
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    for base in (edge, corners):
        values = [cubemap.sample(noise, base + 1e-6 * rng.normal(size=base.shape)) for _ in range(6)]
        assert np.ptp(values, axis=0).max() < 1e-4


@pytest.mark.parametrize(("size", "coarse"), [(16, 8), (10, 5), (9, 5)])
def test_reduction_keeps_constants_flux_and_first_moment(size: int, coarse: int) -> None:
    matrix = cubemap.downsampling_matrix(size, coarse)
    np.testing.assert_allclose(matrix @ np.ones(6 * size * size), 1.0, rtol=1e-12)
    light = np.random.default_rng(4).random(6 * size * size)
    # The flux of the coarse map, with the solid angles that the reduction itself gives its texels.
    angle = np.asarray(cubemap.interpolation_matrix(coarse, cubemap.directions(size).reshape(-1, 3)).T @ cubemap.solid_angles(size).ravel())
    assert angle @ (matrix @ light) == pytest.approx(cubemap.solid_angles(size).ravel() @ light, rel=1e-12)
    np.testing.assert_allclose(angle, cubemap.solid_angles(coarse).ravel(), rtol=0.2)


def test_octahedral_round_trip_and_seams() -> None:
    import torch

    probe = random_directions(1000)
    u, v = octahedral.encode(torch.from_numpy(probe * 2.5))
    np.testing.assert_allclose(octahedral.decode(np.stack([u.numpy(), v.numpy()], axis=1)), probe, atol=1e-12)
    for size in (4, 6):
        dirs = octahedral.texel_directions(size)
        assert (octahedral.texel_index(size, dirs) == np.arange(size * size)).all()
        border = octahedral.border_indices(size)
        assert (border[1:-1, 1:-1].ravel() == np.arange(size * size)).all()
        # A border texel must be the neighbour across the fold: the point where both are equally near lies on the square's edge.
        for row in range(size):
            v_edge = (2 * row + 1) / size - 1
            crossing = octahedral.decode(np.array([-1.0, v_edge]))
            near = dirs[border[row + 1, 0]] @ crossing
            assert near == pytest.approx(dirs[row * size] @ crossing, abs=1e-12)
            assert border[row + 1, 0] == (size - 1 - row) * size
        assert {border[0, 0], border[0, -1], border[-1, 0], border[-1, -1]} == {0, size - 1, size * (size - 1), size * size - 1}


def test_sample_refuses_other_shapes() -> None:
    with pytest.raises(ValueError, match="shape"):
        cubemap.sample(np.zeros((5, 4, 4, 3)), np.ones((1, 3)))
