"""The field of SDF samples: the distance to a ball, against a sum over all samples in float64, gradient against differences."""

from __future__ import annotations

import numpy as np
import torch

from gsbake.config.schema import Loss, Train
from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.surfels.fields.samples import SamplesField
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create

RADIUS = 0.6


def ball(count: int = 3000, offset: float = 0.02) -> Surfels:
    """Surfels in a shell of ±`offset` around a ball, with samples that are their distances from it."""
    p = fibonacci_sphere(count)
    s = create(RADIUS * p, p, RADIUS * spacing(p), None, "colour", 0, 0.0, 50.0)
    s.sdf = offset * torch.linspace(-1, 1, count)[torch.randperm(count, generator=torch.Generator().manual_seed(0))]
    s.position = s.position + s.sdf[:, None] * s.normal()
    return s


def queries(count: int = 200) -> torch.Tensor:
    g = torch.Generator().manual_seed(1)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    return direction * (RADIUS + 0.08 * (torch.rand(count, 1, generator=g) - 0.5))


def test_value_is_the_distance_and_projection_reaches_the_surface() -> None:
    field, x = SamplesField(ball(), Loss()), queries()
    assert float((field.value(x) - (x.norm(dim=1) - RADIUS)).abs().max()) < 2e-3
    assert float((field.project(x).norm(dim=1) - RADIUS).abs().max()) < 2e-3
    assert float((field.project_surfels(field.surfels).norm(dim=1) - RADIUS).abs().max()) < 1e-6


def test_photos_move_the_sharpness_only_in_the_unit_frame() -> None:
    for sharpness in ("unit", "spacing"):
        s = ball(50)
        s.gamma.requires_grad_()
        s.sdf.requires_grad_()
        opacity = SamplesField(s, Loss(), Train(sharpness=sharpness)).opacity(s)
        assert torch.equal(opacity, s.opacity())
        opacity.sum().backward()
        assert s.sdf.grad is not None and bool(s.sdf.grad.any())
        assert (s.gamma.grad is not None) is (sharpness == "unit")


def test_value_equals_the_sum_over_all_samples() -> None:
    s, x = ball(400), queries(50)
    field = SamplesField(s, Loss())
    _, centres, normals, inverse = field._samples()
    offset = x.double()[:, None] - centres.double()
    weight = torch.softmax(-0.5 * inverse.double() * (offset**2).sum(2), 1)
    expected = (weight * (offset * normals.double()).sum(2)).sum(1)
    # twelve nearest samples instead of all, whose weights are below .5 %
    assert torch.allclose(field.value(x).double(), expected, atol=1e-3)


def test_gradient_agrees_with_differences() -> None:
    field, x = SamplesField(ball(400), Loss()), queries(50).double()
    h = 1e-6
    steps = h * torch.eye(3, dtype=torch.float64)
    numeric = torch.stack([(field.value(x + e) - field.value(x - e)) / (2 * h) for e in steps], 1)
    assert float((field.gradient(x) - numeric).abs().max()) < 1e-4


def test_points_on_the_surface_and_the_field_on_a_lattice() -> None:
    s = ball()
    s.gamma = torch.tensor([200.0])
    field = SamplesField(s, Loss())
    points, normals = field.sample_near_zero(500, torch.Generator().manual_seed(0))
    assert len(points) == 500 and float((points.norm(dim=1) - RADIUS).abs().max()) < 1e-5
    assert float((normals * points).sum(1).min()) > 0.5
    lattice = BlockLattice([-0.8] * 3, [0.8] * 3, 0.05)
    lattice.allocate_all()
    values = field.mesh(lattice, 0.2)
    known = np.isfinite(values)
    truth = np.clip((np.linalg.norm(lattice.positions(slice(None)), axis=-1) - RADIUS) / 0.2, -1, 1)
    assert known.mean() > 0.1 and float(np.abs(values - truth)[known & (np.abs(truth) < 0.3)].max()) < 0.1


def test_without_surfels_nothing_is_inside() -> None:
    field = SamplesField(ball().select(torch.zeros(0, dtype=torch.long)), Loss())
    assert field.value(queries(3)).tolist() == [1.0] * 3 and not field.gradient(queries(3)).any()
    assert len(field.sample_near_zero(5, torch.Generator())[0]) == 0
