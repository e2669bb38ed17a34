"""Every continuous field: starts from what is known, its gradients, projection, sampling, meshing, and its files."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsbake.config.schema import Coupling, DistanceField, Loss, Train
from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.known import KnownDistance, SphereDistance
from gsbake.surfels.fields.registry import FIELDS, load_field, make_field, save_field
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from tests.support.slow import slow

RADIUS = 0.6
#: Small enough to be quick. Largest error of the start near the surface.
SMALL = {"resolution": 32, "levels": 4, "table_bits": 12, "rank": 3, "octaves": 3, "width": 16, "fit_steps": 120}
ERROR = {"grid": 0.005, "octree": 0.005, "tensor": 0.02, "hash": 0.02, "mlp": 0.02}


def ball(count: int = 1500) -> Surfels:
    p = fibonacci_sphere(count)
    return create(RADIUS * p, p, RADIUS * spacing(p), None, "colour", 0, 0.0, 50.0)


def profile(kind: str, coupling: dict[str, float] | None = None, **settings: Any) -> SimpleNamespace:
    field = DistanceField(**{"kind": kind, **SMALL} | settings)
    return SimpleNamespace(field=field, coupling=Coupling(**coupling or {}), loss=Loss(), train=Train())


def made(kind: str, surfels: Surfels | None = None, **settings: Any) -> ContinuousField:
    field = make_field(surfels or ball(), profile(kind, **settings), 0)
    assert isinstance(field, ContinuousField)
    return field


def near(count: int = 300, reach: float = 0.1) -> torch.Tensor:
    g = torch.Generator().manual_seed(1)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    return direction * (RADIUS + reach * (2 * torch.rand(count, 1, generator=g) - 1))


@pytest.mark.parametrize("kind", FIELDS)
def test_starts_from_what_is_known(kind: str) -> None:
    field, x = made(kind), near()
    with torch.no_grad():
        assert float((field.value(x) - (x.norm(dim=1) - RADIUS)).abs().max()) < ERROR[kind]
        assert float((field.project(x).norm(dim=1) - RADIUS).abs().mean()) < ERROR[kind]
        outside = torch.tensor([[2.0, 0.0, 0.0], [0.0, -3.0, 0.0]])
        assert torch.allclose(field.value(outside), outside.norm(dim=1) - RADIUS, atol=0.1)
        assert float(field.value(torch.zeros(1, 3))) < -0.4
        slope = torch.nn.functional.normalize(field.gradient(x), dim=1)
        assert float((slope * x).sum(1).div(x.norm(dim=1)).median()) > 0.98  # 11°


@pytest.mark.parametrize("kind", FIELDS)
def test_starts_from_a_sphere_where_nothing_is_to_be_known(kind: str) -> None:
    field = made(kind, start="sphere")
    x = near(50) / RADIUS
    assert float((field.value(x) - (x.norm(dim=1) - 1)).abs().max()) < 0.05


@pytest.mark.parametrize("kind", FIELDS)
def test_gradients_agree_with_differences(kind: str) -> None:
    field, x = made(kind), near(100)
    # away from the start, where the network's last layer or the differences between levels vanish
    g = torch.Generator().manual_seed(2)
    for p in field.parameters().values():
        p += 0.02 * torch.randn(p.shape, generator=g)
    h = 1e-4
    with torch.no_grad():
        f, gradient = field.evaluate(x)
        numeric = torch.stack([(field.evaluate(x + e)[0] - field.evaluate(x - e)[0]) / (2 * h) for e in h * torch.eye(3)], 1)
    close = (gradient - numeric).abs().amax(1) < 0.02 * gradient.norm(dim=1).clamp_min(1)
    assert float(close.float().mean()) > 0.9  # the others cross a face of a cell
    # by the points
    points = x.clone().requires_grad_()
    field.evaluate(points)[0].sum().backward()
    assert points.grad is not None and torch.allclose(points.grad, gradient, atol=1e-4)
    # by the parameters, of a function of value and gradient
    weights = torch.randn(len(x), generator=g), torch.randn(len(x), 3, generator=g)

    def objective() -> torch.Tensor:
        f, gradient = field.evaluate(x)
        return (weights[0] * f).sum() + (weights[1] * gradient).sum()

    for name, p in field.parameters().items():
        p.requires_grad_()
        p.grad = None
        objective().backward()
        assert p.grad is not None
        at = int(p.grad.abs().argmax())
        slope = float(p.grad.view(-1)[at])
        p.requires_grad_(False)
        step = 1e-3
        flat, before = p.view(-1), float(p.view(-1)[at])
        values = []
        for sign in (1, -1):
            flat[at] = before + sign * step
            values.append(float(objective()))
        flat[at] = before
        assert abs((values[0] - values[1]) / (2 * step) - slope) < 0.02 * abs(slope) + 0.05, name


@pytest.mark.parametrize("kind", FIELDS)
def test_points_on_the_surface_and_mesh(kind: str) -> None:
    field = made(kind)
    points, normals = field.sample_near_zero(400, torch.Generator().manual_seed(0))
    assert len(points) > 200 and float((points.norm(dim=1) - RADIUS).abs().mean()) < ERROR[kind]
    assert float((normals * torch.nn.functional.normalize(points, dim=1)).sum(1).mean()) > 0.97
    assert all(float((points[:, a] > 0).float().mean()) > 0.3 for a in range(3))  # all around
    lattice = BlockLattice([-0.8] * 3, [0.8] * 3, 0.1)
    lattice.allocate_all()
    truth = np.clip((np.linalg.norm(lattice.positions(slice(None)), axis=-1) - RADIUS) / 0.2, -1, 1)
    assert np.abs(field.mesh(lattice, 0.2) - truth)[np.abs(truth) < 0.5].max() < 5 * ERROR[kind] + 0.02


@pytest.mark.parametrize("kind", FIELDS)
@pytest.mark.parametrize("extra", [{}, slow({"colour": 1.0})])
def test_file_and_state_hold_all_of_it(kind: str, extra: dict[str, float], tmp_path: Path) -> None:
    surfels = ball(300)
    p = profile(kind, extra, splats=kind == "hash")
    field = make_field(surfels, p, 0)
    for x in field.parameters().values():
        x += 0.01
    save_field(tmp_path, field)
    again = load_field(tmp_path, surfels, p)
    assert type(again) is type(field) and torch.equal(again.value(near()), field.value(near()))
    assert again.parameters().keys() == field.parameters().keys()
    other = make_field(surfels, p, 5)
    other.restore({k: v.clone() for k, v in field.state().items()})
    assert all(torch.equal(v, other.parameters()[k]) for k, v in field.parameters().items())
    save_field(tmp_path, again)
    first = (tmp_path / "field.safetensors").read_bytes()
    save_field(tmp_path, field)
    assert (tmp_path / "field.safetensors").read_bytes() == first


@pytest.mark.parametrize("kind", ["grid", "octree"])
def test_refinement_changes_nothing_at_once(kind: str) -> None:
    field, x = made(kind), near()
    before = field.value(x)
    changed = [field.advance(share) for share in (0.0, 0.3, 0.5, 0.8)]
    assert not changed[0] and torch.allclose(field.value(x), before, atol=1e-5)


def test_a_grid_follows_the_surface() -> None:
    field = made("grid")
    field.coarse += 0.25  # the zero level set shrinks to .35
    blocks = len(field.fine)
    assert field.advance(0.3) and len(field.fine) != blocks
    assert float((field.sample_near_zero(100, torch.Generator().manual_seed(0))[0].norm(dim=1) - 0.35).abs().mean()) < 0.03


def test_known_distance_of_a_ball_and_of_a_thin_plate() -> None:
    p = fibonacci_sphere(3000)
    known = KnownDistance(RADIUS * p, p)
    x = np.random.default_rng(0).uniform(-1.2, 1.2, (2000, 3))
    truth = np.linalg.norm(x, axis=1) - RADIUS
    assert np.abs(known(x) - truth).max() < 0.02
    slope = known.with_gradient(x)[1]
    assert np.einsum("nc,nc->n", slope, x / np.linalg.norm(x, axis=1)[:, None])[np.abs(truth) > 0.03].min() > 0.95
    # two sides of a plate, 2.5 spacings apart: the sign is that of the nearer side
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(-0.5, 0.5, 41))
    side = np.stack([u.ravel(), v.ravel(), np.full(u.size, 0.03)], 1)
    plate = KnownDistance(np.concatenate([side, side * [1, 1, -1]]), np.repeat([[0.0, 0, 1], [0, 0, -1]], len(side), 0))
    z = np.linspace(-0.3, 0.3, 61)
    line = np.stack([np.full(61, 0.111), np.full(61, 0.2), z], 1)
    assert np.abs(plate(line) - (np.abs(z) - 0.03)).max() < 0.012
    off = np.abs(z) > 0.02
    assert np.allclose(plate.with_gradient(line[off])[1][:, 2], np.sign(z[off]), atol=0.4)
    assert np.allclose(SphereDistance(0.5)(np.eye(3)), 0.5)
    assert np.allclose(SphereDistance(0.5).with_gradient(2 * np.eye(3))[1], np.eye(3))


@pytest.mark.slow
def test_nothing_known_is_a_field_too() -> None:
    empty = ball().select(torch.zeros(0, dtype=torch.long))
    for kind in FIELDS:
        assert torch.isfinite(made(kind, empty).value(near(10))).all()
