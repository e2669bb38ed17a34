"""The fused Adam optimiser against torch's, and its errors for values that are not finite."""

from __future__ import annotations

import pytest
import torch

from gsbake.surfels.adam import Adam


def test_matches_torch() -> None:
    g = torch.Generator().manual_seed(0)
    start = torch.randn(1000, 3, generator=g)
    ours, theirs = start.clone(), start.clone().requires_grad_()
    adam, reference = Adam(), torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    for i in range(20):
        grad = torch.randn(1000, 3, generator=g) * 10.0 ** (i % 5 - 2)
        grad[:10] = 0
        adam.step("x", ours, grad, 0.01)
        theirs.grad = grad
        reference.step()
    assert torch.allclose(ours, theirs.detach(), atol=2e-6)
    assert torch.equal(ours[:10], start[:10])


def test_selecting_rows_keeps_their_moments() -> None:
    adam, x = Adam(), torch.zeros(4, 2)
    adam.step("x", x, torch.ones(4, 2), 0.1)
    adam.select(["x"], torch.tensor([0, 2]), 3)
    assert adam.first["x"].shape == (5, 2) and adam.first["x"][:2].eq(0.1).all() and adam.first["x"][2:].eq(0).all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_error_names_the_tensor_that_is_not_finite(bad: float) -> None:
    grad = torch.ones(50, 3)
    grad[17, 1] = bad
    with pytest.raises(FloatingPointError, match=r"gradient of log_scale \(row 17\) is not finite"):
        Adam().step("log_scale", torch.zeros(50, 3), grad, 0.1)
    value = torch.zeros(50, 3)
    value[4, 0] = bad
    with pytest.raises(FloatingPointError, match=r"^position \(row 4\) is not finite"):
        Adam().step("position", value, torch.ones(50, 3), 0.1)
    with pytest.raises(FloatingPointError, match="squared gradient of sdf"):
        Adam().step("sdf", torch.zeros(2), torch.tensor([1.0, 1e25]), 0.1)
