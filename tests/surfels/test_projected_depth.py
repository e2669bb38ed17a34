"""Depth of surfels moved by their signed distance: as if they lay on the zero level set."""

from __future__ import annotations

import torch

from gsbake.surfels.gbuffer import rasterise
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.views import TrainView, camera_tensors
from tests.support.cameras import look_at

RADIUS, SIZE = 0.6, 64


def shell(offset: float) -> Surfels:
    """A ball whose surfels all lie `offset` off it and know it."""
    p = fibonacci_sphere(4000)
    s = create((RADIUS + offset) * p, p, 2 * RADIUS * spacing(p), None, "colour", 0, 0.0, 4.0)
    s.sdf = torch.full_like(s.sdf, offset)
    return s


def view() -> TrainView:
    r, t, centre, pinhole = camera_tensors(look_at([0.2, -2.4, 0.4], size=SIZE, focal=70.0))
    return TrainView("v", torch.zeros(3, SIZE, SIZE, dtype=torch.uint8), None, r, t, centre, pinhole)


def test_the_depth_is_that_of_the_zero_level_set() -> None:
    for offset in (0.02, -0.02):
        surfels, v = shell(offset), view()
        truth = rasterise(shell(0.0), v)
        plain, moved = rasterise(surfels, v), rasterise(surfels, v, distance=surfels.sdf)
        frontal = (truth.alpha > 0.99) & (plain.alpha > 0.99)
        frontal[:, : SIZE // 3] = frontal[:, 2 * SIZE // 3 :] = False
        frontal[: SIZE // 3] = frontal[2 * SIZE // 3 :] = False
        before = (plain.expected_depth() - truth.expected_depth())[frontal].abs().mean()
        after = (moved.expected_depth() - truth.expected_depth())[frontal].abs().mean()
        assert float(before) > 0.012 and float(after) < 0.1 * float(before)
        assert float((moved.median - truth.median)[frontal].abs().mean()) < 0.1 * float(before) + 0.002
        # everything else is as it was
        assert torch.equal(moved.features, plain.features) and torch.equal(moved.alpha, plain.alpha)
        assert moved.planes.shape == plain.planes.shape
        assert torch.equal(moved.planes[-5:], plain.planes[-5:])


def test_gradient_reaches_the_distance() -> None:
    surfels, v = shell(0.02), view()
    distance = surfels.sdf.clone().requires_grad_()
    rasterise(surfels, v, distance=distance).depth.sum().backward()
    assert distance.grad is not None
    numeric = []
    for step in (1e-3, -1e-3):
        with torch.no_grad():
            numeric.append(float(rasterise(surfels, v, distance=surfels.sdf + step).depth.double().sum()))
    assert abs((numeric[0] - numeric[1]) / 2e-3 - float(distance.grad.sum())) < 0.01 * abs(float(distance.grad.sum()))
