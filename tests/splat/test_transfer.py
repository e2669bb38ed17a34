"""The SDF → opacity transfer against the literal formula, its inverse and its derivative."""

from __future__ import annotations

import math

import pytest
import torch

from gsbake.splat import transfer


def test_against_the_literal_formula_and_the_published_table() -> None:
    s = torch.linspace(-5, 5, 101, dtype=torch.float64)
    gamma = torch.tensor(1.7, dtype=torch.float64)
    literal = 4 * torch.exp(-gamma * s) / (1 + torch.exp(-gamma * s)) ** 2
    assert torch.allclose(transfer.opacity(s, gamma), literal, atol=1e-14)
    # γ|s| at which o = .5, .1, .01, .005, 1/255
    for o, x in ((0.5, 1.763), (0.1, 3.637), (0.01, 5.986), (0.005, 6.682), (1 / 255, 6.926)):
        assert float(transfer.distance(torch.tensor(o), torch.tensor(1.0))) == pytest.approx(x, abs=1e-3)


@pytest.mark.parametrize("x", [0.0, 1e-6, 1.0, 88.0, 1e3, 1e4, -1e4])
def test_finite_and_even_everywhere(x: float) -> None:
    s = torch.tensor(x, requires_grad=True)
    gamma = torch.tensor(1.0, requires_grad=True)
    o = transfer.opacity(s, gamma)
    o.backward()
    assert torch.isfinite(o.detach()) and torch.isfinite(s.grad) and torch.isfinite(gamma.grad)
    assert float(o.detach()) == pytest.approx(float(transfer.opacity(-s.detach(), gamma.detach())))


def test_derivative() -> None:
    """∂T/∂s = −γ tanh(γs/2) T and ∂T/∂γ = −s tanh(γs/2) T."""
    s = torch.tensor([0.3, -0.7, 2.0], dtype=torch.float64, requires_grad=True)
    gamma = torch.tensor(2.5, dtype=torch.float64, requires_grad=True)
    o = transfer.opacity(s, gamma)
    o.sum().backward()
    d = torch.tanh(gamma * s / 2).detach() * o.detach()
    assert torch.allclose(s.grad, -gamma.detach() * d)
    assert torch.allclose(gamma.grad, -(s.detach() * d).sum())


def test_median_targets() -> None:
    assert pytest.approx(1.7627, abs=1e-4) == transfer.HALF
    assert pytest.approx(4.549, abs=2e-3) == transfer.GAMMA_GOAL
    assert float(transfer.opacity(torch.tensor(0.1), torch.tensor(transfer.GAMMA_GOAL))) == pytest.approx(0.95, abs=1e-5)
    assert float(transfer.opacity(torch.tensor(0.4), torch.tensor(transfer.median_target(0.4)))) == pytest.approx(0.5, abs=1e-6)
    assert math.isclose(transfer.median_target(0.01), transfer.GAMMA_GOAL)
