"""The silhouette loss: value and gradient against lengths worked out by hand, and surfels on a sphere that find a ball."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsbake.config.schema import Profile
from gsbake.imaging.distance import distance_to_zero
from gsbake.surfels.fields.samples import SamplesField
from gsbake.surfels.initialisation import fibonacci_sphere
from gsbake.surfels.losses.terms import silhouette_distance
from gsbake.surfels.model import create
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.views import TrainView

VIEW = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)


def half_plane() -> torch.Tensor:
    """Pixels to a mask that covers the columns up to 19."""
    outside = np.ones((48, 64), bool)
    outside[:, :20] = False
    return torch.from_numpy(distance_to_zero(outside))


def test_lengths_across_the_view() -> None:
    pixels = torch.tensor([[30.5, 20.5], [10.5, 5.5], [50.5, 40.5]])  # pixel centres 11, 0 and 31 columns from the mask
    z = torch.tensor([2.0, 1.0, 4.0])
    points = torch.stack([(pixels[:, 0] - 32) * z / 50, (pixels[:, 1] - 24) * z / 50, z], 1)
    expected = (11 * 2 / 50 + 31 * 4 / 50) / 3
    assert float(silhouette_distance(points, half_plane(), torch.eye(3), torch.zeros(3), VIEW)) == pytest.approx(expected, rel=1e-5)
    behind = points * torch.tensor([1.0, 1.0, -1.0])
    assert float(silhouette_distance(behind, half_plane(), torch.eye(3), torch.zeros(3), VIEW)) == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e38])
def test_a_point_that_is_not_finite_is_left_out(value: float) -> None:
    points = torch.tensor([[0.3, 0.1, 2.0], [value, 0.1, 2.0], [0.1, 0.1, value]], requires_grad=True)
    loss = silhouette_distance(points, half_plane(), torch.eye(3), torch.zeros(3), VIEW)
    loss.backward()
    assert torch.isfinite(loss) and points.grad is not None
    assert torch.isfinite(points.grad).all() and float(points.grad[0].abs().sum()) > 0


def test_gradient_is_one_across_the_view_and_none_along_it() -> None:
    points = torch.tensor([[0.3, 0.1, 2.0], [0.55, -0.2, 1.5]], requires_grad=True)
    silhouette_distance(points, half_plane(), torch.eye(3), torch.zeros(3), VIEW).backward()
    assert points.grad is not None
    assert torch.allclose(points.grad[:, 0], torch.full((2,), 0.5), atol=1e-3)  # half of each point's length: the mean of two
    assert points.grad[:, 1].abs().max() < 1e-6
    # as the ray turns with depth, the point moves across it: −x / z of the slope
    assert torch.allclose(points.grad[:, 2], -0.5 * points.detach()[:, 0] / points.detach()[:, 2], atol=1e-3)


def looking_at_the_origin(direction: np.ndarray, distance: float) -> tuple[torch.Tensor, torch.Tensor]:
    forward = -direction
    right = np.cross([0.1, 0.9, 0.4], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return torch.from_numpy(rotation).float(), torch.tensor([0.0, 0.0, distance])


def test_a_sphere_finds_a_ball() -> None:
    """Masks of a ball of radius .4; surfels start on a sphere of radius 1.1."""
    size, views = 48, []
    view = Pinhole(size, size, 60.0, 60.0, size / 2, size / 2)
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    radius = 60 * 0.4 / math.sqrt(3**2 - 0.4**2)
    mask = torch.from_numpy(np.where(np.hypot(x, y) < radius, 255, 0).astype(np.uint8))
    for i, direction in enumerate(fibonacci_sphere(16)):
        rotation, t = looking_at_the_origin(direction, 3.0)
        views.append(TrainView(f"{i}", (mask // 2).expand(3, size, size).contiguous(), mask, rotation, t, -rotation.T @ t, view))
    points = 1.1 * fibonacci_sphere(600)
    medians = {}
    for weight in (0.0, 300.0):
        profile = Profile()
        loss = profile.loss.model_copy(update={"silhouette": weight})
        train = profile.train.model_copy(update={"lr_position": 2e-2})
        surfels = create(points, points, np.full(600, 0.1), None, "colour", 0, 0.01, 1.0, "sech2")
        plan = Plan(train, profile.surfels, loss, 600, 0.0, False, 0)
        trainer = Trainer(plan, surfels, None, views, views, [], [], SamplesField(surfels, loss, train))
        while trainer.done < trainer.end:
            trainer.step()
        medians[weight] = float(trainer.surfels.position.norm(dim=1).median())
    assert medians[0.0] > 0.9
    assert medians[300.0] == pytest.approx(0.4, abs=0.06)
