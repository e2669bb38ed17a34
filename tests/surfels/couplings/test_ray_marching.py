"""Ray marching: the surface that each transfer function finds, its limits, and sphere tracing, on a ball."""

from __future__ import annotations

import pytest
import torch

from gsbake.surfels.couplings.ray_marching import alphas, make_rays, march, sample_depths, sphere_trace, weights
from gsbake.surfels.field import Field
from gsbake.surfels.views import TrainView, camera_tensors
from tests.support.cameras import look_at

RADIUS, SIZE = 0.6, 32


class Ball(Field):
    """The exact distance to a ball."""

    name = "ball"

    def distance(self, surfels):  # type: ignore[no-untyped-def]
        return self.value(surfels.position)

    def value(self, points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=1) - RADIUS

    def gradient(self, points: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.normalize(points, dim=1)

    def sample_near_zero(self, count, generator):  # type: ignore[no-untyped-def]
        normal = torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=1)
        return RADIUS * normal, normal

    def losses(self, step, view):  # type: ignore[no-untyped-def]
        return None

    def mesh(self, lattice, truncation):  # type: ignore[no-untyped-def]
        raise NotImplementedError


def view() -> TrainView:
    r, t, centre, pinhole = camera_tensors(look_at([0.3, -2.4, 0.5], size=SIZE, focal=30.0))
    return TrainView("v", torch.zeros(3, SIZE, SIZE, dtype=torch.uint8), None, r, t, centre, pinhole)


def true_depth(rays) -> torch.Tensor:  # type: ignore[no-untyped-def]
    """z-depth of the ball on each ray; 0 where it misses."""
    d, o = rays.direction.double(), rays.origin.double()
    a, b, c = (d * d).sum(1), d @ o, o @ o - RADIUS**2
    root = b * b - a * c
    return torch.where(root > 0, (-b - root.clamp_min(0).sqrt()) / a, 0.0).float()


BOX = torch.full((3,), -1.0), torch.full((3,), 1.0)


@pytest.mark.parametrize("transfer", ["neus", "laplace", "logistic"])
def test_marched_depth_and_normal(transfer: str) -> None:
    rays = make_rays(view(), torch.arange(SIZE * SIZE), *BOX)
    truth = true_depth(rays)
    frontal = (truth > 0) & ((rays.at(truth[:, None])[:, 0] * rays.direction).sum(1) / (RADIUS * rays.length) < -0.5)
    centre = torch.where(truth > 0, truth + 0.01, 0.0)
    z = sample_depths(rays, 32, centre, torch.full_like(centre, 0.1), centre > 0, torch.Generator().manual_seed(0))
    field = Ball()
    m = march(rays, z, transfer, torch.tensor(150.0), lambda x: (field.value(x), field.gradient(x)))
    assert float(m.alpha[frontal].min()) > 0.9
    error = (m.depth - truth)[frontal]
    # the bump is opaque on both sides of the surface: half of it is absorbed before the surface, about 2.5 / γ
    most = 0.025 if transfer == "logistic" else 0.012
    assert float(error.abs().mean()) < most and float(error.mean().abs()) < most
    truth_normal = torch.nn.functional.normalize(rays.at(truth[:, None])[:, 0], dim=1)
    assert float((m.normal * truth_normal).sum(1)[frontal].min()) > 0.99
    miss = (truth == 0) & (rays.near < rays.far)
    z = sample_depths(rays, 64, torch.zeros_like(truth), torch.zeros_like(truth), truth < 0, torch.Generator().manual_seed(0))
    outside = march(rays, z, transfer, torch.tensor(150.0), lambda x: (field.value(x), field.gradient(x)))
    clear = miss & (outside.f.amin(1) > 0.05)
    assert bool(clear.any()) and float(outside.alpha[clear].max()) < 0.05


def test_sphere_tracing_meets_the_surface() -> None:
    rays = make_rays(view(), torch.arange(SIZE * SIZE), *BOX)
    truth = true_depth(rays)
    z, hit = sphere_trace(Ball().value, rays)
    grazing = (truth > 0) & ((rays.at(truth[:, None])[:, 0] * rays.direction).sum(1) / (RADIUS * rays.length) > -0.3)
    assert bool((hit == (truth > 0))[~grazing & ((truth > 0) | (rays.at(z[:, None])[:, 0].norm(dim=1) > 0.65))].all())
    assert float((z - truth)[hit & ~grazing & (truth > 0)].abs().max()) < 0.02


@pytest.mark.parametrize("transfer", ["neus", "laplace", "logistic"])
@pytest.mark.parametrize("sharpness", [1e-6, 1.0, 1e6])
def test_alpha_is_a_probability_for_any_value(transfer: str, sharpness: float) -> None:
    f = torch.tensor([[1e6, 1.0, 1e-9, 0.0, -1e-9, -1.0, -1e6], [0.0] * 7, [-1e6] * 7, [1e30] * 7]).requires_grad_()
    length = torch.tensor([[0.0, 1e-9, 1e-3, 1.0, 1e3, 1.0, 1.0]]).expand(4, 7)
    w = weights(alphas(transfer, f, length, torch.tensor(sharpness)))
    assert bool(((w >= 0) & (w <= 1)).all()) and float(w.detach().sum(1).max()) < 1 + 1e-4
    w.sum().backward()
    assert f.grad is not None and torch.isfinite(f.grad).all()


def test_rays_that_miss_the_box_and_axis_parallel_ones() -> None:
    rays = make_rays(view(), torch.tensor([0, SIZE * SIZE // 2]), torch.full((3,), 5.0), torch.full((3,), 6.0))
    assert bool((rays.near > rays.far).all())
    z = sample_depths(rays, 4, torch.zeros(2), torch.zeros(2), torch.zeros(2, dtype=torch.bool), torch.Generator().manual_seed(0))
    assert torch.isfinite(z).all() and bool((z.diff(dim=1) >= 0).all())
