"""The fused projection loss against its PyTorch twin in float64."""

from __future__ import annotations

import pytest
import torch

from gsbake.surfels.losses import terms as losses
from gsbake.surfels.losses.projection import projection_loss
from gsbake.surfels.raster.projection import Pinhole

H, W = 41, 52


@pytest.mark.parametrize("n", [1, 700, 9000])
def test_projection(n: int) -> None:
    g = torch.Generator().manual_seed(n)
    position = torch.randn(n, 3, generator=g) * torch.tensor([1.2, 1.2, 0.1])
    normal = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    sdf, visible = 0.05 * torch.randn(n, generator=g), torch.rand(n, generator=g) > 0.2
    alpha = torch.rand(H, W, generator=g)
    alpha[alpha < 0.01] = 0
    depth = alpha * (3 + 0.05 * torch.rand(H, W, generator=g))
    turn, t = torch.eye(3), torch.tensor([0.1, -0.2, 3.0])
    if n > 5:
        position[3, 2], position[4] = -3.0, torch.tensor([0.0, 0.0, -9.0])  # at the camera's plane, and behind it
        visible[3:5] = True
    view = Pinhole(W, H, 60.0, 55.0, 25.0, 20.0)
    leaves = [x.clone().requires_grad_() for x in (position, normal, sdf)]
    twins = [x.double().requires_grad_() for x in (position, normal, sdf)]
    fast = projection_loss(*leaves, visible, depth, alpha, turn, t, view)
    slow = losses.projection_loss(*twins, visible, depth.double(), alpha.double(), turn.double(), t.double(), view)
    assert float(fast.detach()) == pytest.approx(float(slow.detach()), rel=1e-4, abs=1e-9)
    (2 * fast).backward()
    (2 * slow).backward()
    for a, b in zip(leaves, twins, strict=True):
        assert a.grad is not None and b.grad is not None
        assert (a.grad - b.grad).norm() <= 1e-4 * b.grad.norm()
    if n > 5:
        assert float(slow.detach()) > 0 and float(twins[0].grad.norm()) > 0 and not bool(leaves[0].grad[3:5].any())  # type: ignore[union-attr, index]


def test_no_surfel() -> None:
    nothing = torch.zeros(0, 3).requires_grad_()
    none, plane, view = torch.zeros(0), torch.ones(H, W), Pinhole(W, H, 9.0, 9.0, 9.0, 9.0)
    value = projection_loss(nothing, nothing.detach(), none, none.bool(), plane, plane, torch.eye(3), torch.zeros(3), view)
    value.backward()
    assert float(value.detach()) == 0 and nothing.grad is not None
