"""The prefilter against closed forms and brute-force integration of the continuous environment."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.sparse
import torch

from gsbake.geometry.vectors import unit
from gsbake.shading import cubemap, prefilter
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import LightTables, _sparse_tensor, irradiance, prefilter_cube_map


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    return unit(np.random.default_rng(seed).normal(size=(count, 3)))


def lookup(tables: LightTables, dirs: np.ndarray, roughness: float) -> np.ndarray:
    with torch.no_grad():
        rough = torch.full((len(dirs),), roughness, dtype=tables.table.dtype)
        return tables.specular(torch.from_numpy(dirs).to(tables.table.dtype), rough).numpy()


def room(dirs: np.ndarray) -> np.ndarray:
    """Sky, a warm window and a dark floor: smooth, but bright over some degrees."""
    window = np.exp(25.0 * (dirs @ unit(np.array([0.5, -0.6, 0.6])) - 1.0))
    sky = 0.4 + 0.25 * dirs[:, 2] + 0.1 * np.sin(5 * dirs[:, 0])
    return sky[:, None] * np.array([0.8, 0.9, 1.0]) + 12.0 * window[:, None] * np.array([1.0, 0.8, 0.5])


def test_shared_matrices_stay_as_they_are() -> None:
    """Fits in several threads read them at the same time."""
    rows, columns = np.array([0, 0, 1, 1]), np.array([3, 1, 2, 0])
    matrix = scipy.sparse.csr_matrix((np.arange(1.0, 5), columns, np.array([0, 2, 4])), shape=(2, 4))
    found = _sparse_tensor(matrix, torch.float64, torch.device("cpu"))
    assert (matrix.indices == columns).all() and not matrix.has_sorted_indices
    expected = np.zeros((2, 4))
    expected[rows, columns] = np.arange(1.0, 5)
    np.testing.assert_array_equal(found.to_dense().numpy(), expected)


@pytest.mark.parametrize("size", [4, 10, 16, 32])
def test_constant_light_stays_constant(size: int) -> None:
    tables = EnvironmentLight(size, 2.5).prefilter()
    assert tables.table.shape == (tables.layout.texels, 3)
    torch.testing.assert_close(tables.table, torch.full_like(tables.table, 2.5), rtol=2e-5, atol=0)
    probe = torch.from_numpy(random_directions(50)).float()
    torch.testing.assert_close(tables.diffuse(probe), torch.full((50, 3), 2.5), rtol=2e-5, atol=0)


def test_last_level_is_the_cosine_irradiance_of_a_single_texel() -> None:
    size = 32
    cube = torch.zeros(6, size, size, 3, dtype=torch.float64)
    cube[4, 20, 11] = torch.tensor([100.0, 50.0, 10.0])
    flux = cube[4, 20, 11].numpy() * cubemap.solid_angles(size)[4, 20, 11]
    probe = random_directions(400)
    cosine = np.clip(probe @ cubemap.directions(size)[4, 20, 11], 0, None)
    expected = cosine[:, None] * flux / math.pi
    got = prefilter_cube_map(cube).diffuse(torch.from_numpy(probe)).numpy()
    assert np.abs(got - expected).max() / expected.max() < 0.08  # worst at the terminator's kink
    assert np.sqrt(((got - expected) ** 2).mean() / (expected**2).mean()) < 0.04


def test_irradiance_is_the_last_level_of_the_whole_table() -> None:
    cube = torch.rand(6, 12, 12, 3, generator=torch.Generator().manual_seed(0))
    probe = random_directions(50).astype(np.float32)
    whole = prefilter_cube_map(cube).diffuse(torch.from_numpy(probe)).numpy()
    np.testing.assert_allclose(irradiance(cube.numpy(), probe), whole, rtol=1e-6)


def test_hemisphere_light_gives_the_linear_irradiance() -> None:
    # A hemisphere of radiance 1 around +Z gives E(n)/π = (1 + n·z)/2.
    light = EnvironmentLight.from_function(lambda d: (d[:, 2:] > 0) * np.ones(3), 32)
    probe = random_directions(300)
    got = light.prefilter().diffuse(torch.from_numpy(probe).float()).detach().numpy()
    np.testing.assert_allclose(got, np.repeat((1 + probe[:, 2:]) / 2, 3, axis=1), atol=0.03)
    assert np.abs(got - (1 + probe[:, 2:]) / 2).mean() < 0.006


@pytest.mark.parametrize("roughness", [0.12, 0.2, 0.26, 0.32, 0.44, 0.5, 0.6, 0.85, 1.0])
def test_specular_against_monte_carlo(roughness: float) -> None:
    """Quasi-random samples of the GGX lobe, turned at random per direction, on the analytic environment (not on the cube map)."""
    size, count = 32, 4000
    tables = EnvironmentLight.from_function(room, size).prefilter()
    probe = np.concatenate([random_directions(60, 5), [[0.5, -0.6, 0.6]]])
    probe = unit(probe)
    rng = np.random.default_rng(6)
    alpha = roughness**2
    u = (np.arange(count) + 0.5) / count
    phi = 2 * math.pi * ((np.arange(count) * 0.6180339887 + rng.random((len(probe), 1))) % 1)
    theta = 2 * np.arctan(alpha * np.sqrt(u / (1 - u)))
    side = unit(np.cross(probe, [0.31, 0.82, -0.47]))
    other = np.cross(probe, side)
    ring = np.cos(phi)[..., None] * side[:, None] + np.sin(phi)[..., None] * other[:, None]
    lights = np.sin(theta)[None, :, None] * ring + np.cos(theta)[None, :, None] * probe[:, None]
    weight = np.clip(np.cos(theta), 0, None)
    truth = (room(lights.reshape(-1, 3)).reshape(len(probe), count, 3) * weight[None, :, None]).sum(axis=1) / weight.sum()
    got = lookup(tables, probe, roughness)
    assert np.sqrt(((got - truth) ** 2).mean() / (truth**2).mean()) < 0.05
    assert np.abs(got - truth).max() < 0.08 * truth.max()


def test_sharp_level_keeps_the_map() -> None:
    light = EnvironmentLight.from_function(room, 32)
    probe = random_directions(300)
    got = lookup(light.prefilter(), probe, 0.08)
    assert np.sqrt(((got - room(probe)) ** 2).mean() / (room(probe) ** 2).mean()) < 0.03


@pytest.mark.parametrize("roughness", [0.08, 0.2, 0.4, 1.0])
def test_a_sun_is_brightest_where_it_stands(roughness: float) -> None:
    sun = unit(np.array([0.37, 0.62, -0.69]))
    light = EnvironmentLight.from_function(lambda d: 0.1 + 200.0 * (d @ sun > math.cos(math.radians(3)))[:, None] * np.ones(3), 32)
    probe = np.concatenate([random_directions(4000, 7), sun[None]])
    seen = lookup(light.prefilter(), probe, roughness)[:, 1]
    bright = probe[seen > 0.9 * seen.max()].mean(axis=0)
    assert math.degrees(math.acos(min(1.0, float(unit(bright) @ sun)))) < 3.0


def test_no_seams() -> None:
    """Crossing the octahedron's edges and folds changes nothing by a jump, at any level."""
    cube = torch.from_numpy(np.random.default_rng(8).random((6, 16, 16, 3)))
    tables = prefilter_cube_map(cube)
    rng = np.random.default_rng(9)
    edge = rng.normal(size=(200, 3))
    edge[np.arange(200), rng.integers(0, 3, 200)] = 0.0
    edge = np.concatenate([edge, [[0, 0, -1], [0, 0, 1], [1, 0, 0], [0, -1, 0], [-1, 0, -1e-9]]])
    for roughness in (0.08, 0.16, 0.3, 0.7, 1.0):
        values = [lookup(tables, edge + 1e-7 * rng.normal(size=edge.shape), roughness) for _ in range(6)]
        assert np.ptp(values, axis=0).max() < 1e-4
    step = [lookup(tables, edge[:20], k + s) for k in prefilter.ROUGHNESS_LEVELS[1:-1] for s in (-1e-7, 1e-7)]
    for below, above in zip(step[::2], step[1::2], strict=True):
        np.testing.assert_allclose(below, above, atol=1e-4)


def test_mirrored_environments_give_mirrored_tables() -> None:
    probe = random_directions(100)
    flip = np.array([1.0, -1.0, 1.0])
    plain = EnvironmentLight.from_function(room, 16).prefilter()
    mirrored = EnvironmentLight.from_function(lambda d: room(d * flip), 16).prefilter()
    for roughness in (0.1, 0.4):
        np.testing.assert_allclose(lookup(plain, probe, roughness), lookup(mirrored, probe * flip, roughness), rtol=1e-4, atol=1e-5)


def test_gradients() -> None:
    cube = torch.rand(6, 4, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    probe = torch.from_numpy(random_directions(5, 11)).requires_grad_(True)
    rough = torch.tensor([0.1, 0.2, 0.45, 0.6, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c, d, r: prefilter_cube_map(c).specular(d, r), (cube, probe, rough), fast_mode=True)
    assert torch.autograd.gradcheck(lambda c, d: prefilter_cube_map(c).diffuse(d), (cube, probe), fast_mode=True)


def test_roughness_below_the_first_level_can_come_back() -> None:
    tables = EnvironmentLight.from_function(room, 8).prefilter()
    rough = torch.tensor([0.01], requires_grad=True)
    dirs = torch.nn.functional.normalize(torch.tensor([[0.5, -0.6, 0.6]]), dim=1)
    out = tables.specular(dirs, rough)
    torch.testing.assert_close(out, tables.specular(dirs, torch.tensor([0.08])))
    out.sum().backward()
    assert rough.grad is not None and rough.grad.item() < 0  # less rough would see more of the window


def test_refuses_tiny_maps() -> None:
    with pytest.raises(ValueError, match="at least 4"):
        prefilter.prefilter_operator(2)
