"""Every coupling: small where surfels and field agree with the truth, larger where they do not, and its gradients against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsbake.surfels.couplings.combined import COUPLINGS, combined_losses
from gsbake.surfels.couplings.extra_views import view_between
from gsbake.surfels.couplings.priors import fit_scale_and_shift
from gsbake.surfels.field import TrainingStep
from gsbake.surfels.gbuffer import rasterise
from gsbake.surfels.views import TrainView
from tests.support.slow import slow
from tests.surfels.couplings.scene import RADIUS, ball, field_of, inputs, normals_of, views


@pytest.fixture(scope="module")
def photos() -> list[TrainView]:
    made = views()
    normals = torch.from_numpy(np.rint(127 * normals_of(made[0])).astype(np.int8))
    with torch.no_grad():
        out = rasterise(ball(), made[0])
    depths = torch.where(out.alpha > 0.9, 3 * out.expected_depth() - 1, 0.0)  # another unit and origin
    return [replace(made[0], normals=normals, depths=depths), *made[1:]]


def value(name: str, radius: float, photos: list[TrainView], surfels_radius: float = RADIUS) -> float:
    field = field_of("grid", radius, {"colour": 1.0})
    with torch.no_grad():
        return float(COUPLINGS[name](inputs(field, ball(surfels_radius), photos)))


#: Coupling → (its largest value where all agree, its least value where the field's ball has .75 of the radius).
AGREE = {
    "surface": (0.1, 2.0),
    "depth": (0.05, 0.1),
    "free_space": (0.01, -1.0),
    "silhouette": (0.3, 0.5),
    "pulling": (0.3, 2.0),
    "mask": (0.35, 0.5),
    "extra_views": (0.5, 1.0),
    "opacity_target": (0.1, 0.4),
}


@pytest.mark.parametrize("name", AGREE)
def test_small_where_field_and_surfels_agree(name: str, photos: list[TrainView]) -> None:
    most, least = AGREE[name]
    assert value(name, RADIUS, photos) < most
    assert value(name, 0.75 * RADIUS, photos) > least


@pytest.mark.parametrize("name", ["alignment", "normals", "eikonal", "smoothness", "prior_normals", "prior_depths"])
def test_small_on_the_truth(name: str, photos: list[TrainView]) -> None:
    assert value(name, RADIUS, photos) < {"prior_normals": 0.5, "prior_depths": 0.6, "smoothness": 0.25}.get(name, 0.05)


def test_depth_and_free_space_grow_with_the_difference(photos: list[TrainView]) -> None:
    assert value("depth", 0.9 * RADIUS, photos) > 2 * value("depth", RADIUS, photos)
    assert value("extra_views", 0.9 * RADIUS, photos) > 3 * value("extra_views", RADIUS, photos)
    # the field has a surface before the depth of the surfels
    assert value("free_space", RADIUS, photos, 0.7 * RADIUS) > 0.2


#: The target of the opacities is detached, and given depths are fitted to the present ones: differences see more than the gradient.
WITH_GRADIENT = [name for name in COUPLINGS if name not in ("opacity_target", "prior_depths")]


@pytest.mark.parametrize(("name", "kind"), [*((name, "grid") for name in WITH_GRADIENT), slow("eikonal", "hash"), slow("colour", "hash")])
def test_gradients_agree_with_differences(name: str, kind: str, photos: list[TrainView]) -> None:
    # free space is violated by a surface before the surfels alone
    field = field_of(kind, (1.1 if name == "free_space" else 0.97) * RADIUS, {"colour": 1.0})
    surfels = ball()

    def loss(seed: int = 3) -> torch.Tensor:
        return COUPLINGS[name](inputs(field, surfels, photos, seed))

    parameters = field.parameters()
    for p in parameters.values():
        p.requires_grad_()
        p.grad = None
    loss().backward()
    gradients = {k: p.grad.clone() for k, p in parameters.items() if p.grad is not None and bool(p.grad.any())}
    for p in parameters.values():
        p.requires_grad_(False)
    assert gradients
    for key, gradient in gradients.items():
        direction = gradient / gradient.norm()
        step = 5e-3 if kind == "hash" else 1e-3
        values = []
        for sign in (1, -1):
            parameters[key] += sign * step * direction
            with torch.no_grad():
                values.append(float(loss()))
            parameters[key] -= sign * step * direction
        numeric, expected = (values[0] - values[1]) / (2 * step), float(gradient.norm())
        # samples move with the field, branches switch, detached halves are missing: the direction and the order of magnitude must hold
        assert 0.3 * expected - 1e-3 < numeric < 3 * expected + 1e-3, key


def test_gradients_reach_the_surfels(photos: list[TrainView]) -> None:
    field = field_of("grid", 0.97 * RADIUS)
    for name, leaf in (("surface", "position"), ("depth", "position"), ("normals", "quaternion"), ("alignment", "quaternion")):
        surfels = ball()
        for x in surfels.tensors().values():
            x.requires_grad_()
        COUPLINGS[name](inputs(field, surfels, photos)).backward()
        gradient = getattr(surfels, leaf).grad
        assert gradient is not None and torch.isfinite(gradient).all() and bool(gradient.any()), name


def test_a_field_supervises_surfels_in_the_second_half_only(photos: list[TrainView]) -> None:
    field = field_of("grid", 0.97 * RADIUS)
    for name, leaf in (("depth", "position"), ("normals", "quaternion")):
        for share, expected in ((0.49, False), (0.5, True)):
            surfels = ball()
            for x in [*surfels.tensors().values(), *field.parameters().values()]:
                x.requires_grad_()
                x.grad = None
            COUPLINGS[name](inputs(field, surfels, photos, share=share)).backward()
            gradient = getattr(surfels, leaf).grad
            assert (gradient is not None and bool(gradient.any())) is expected, (name, share)
            assert any(x.grad is not None and bool(x.grad.any()) for x in field.parameters().values()), name


def test_the_sum_is_weighted_and_nothing_is_none(photos: list[TrainView]) -> None:
    field, surfels = field_of("grid", 0.97 * RADIUS), ball()
    out = rasterise(surfels, photos[0])

    def total(**weights: float) -> torch.Tensor | None:
        coupling = field.coupling.model_copy(update=weights)
        step = TrainingStep(surfels, out, 0.5, True, torch.Generator().manual_seed(0), photos)
        field.follow(surfels)
        return combined_losses(field, step, photos[0], field.loss, coupling)

    assert total() is None
    one, two = total(surface=1.0), total(surface=2.0)
    assert one is not None and two is not None and abs(float(two) - 2 * float(one)) < 1e-5


def test_scale_and_shift() -> None:
    x = torch.rand(50, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(fit_scale_and_shift(3 * x - 7, x), x, atol=1e-5)
    assert torch.allclose(fit_scale_and_shift(torch.ones(50), x), x.mean().expand(50))


def test_a_view_between_two_looks_at_the_object(photos: list[TrainView]) -> None:
    between = view_between(photos[0], photos[1], 0.5)
    assert torch.allclose(between.R @ between.R.T, torch.eye(3), atol=1e-5) and abs(float(torch.linalg.det(between.R)) - 1) < 1e-5
    assert abs(float(between.centre.norm()) - 2.5) < 0.05
    towards = torch.nn.functional.normalize(-between.centre, dim=0)
    assert float(between.R[2] @ towards) > 0.99
    same = view_between(photos[0], photos[0], 0.5)
    assert torch.allclose(same.R, photos[0].R, atol=1e-5) and torch.allclose(same.t, photos[0].t, atol=1e-4)
