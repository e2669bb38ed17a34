"""Colours from harmonics against the PyTorch twin in float64, and the basis against what makes it one."""

from __future__ import annotations

import pytest
import torch

from gsbake.surfels import spherical_harmonics as harmonics


@pytest.mark.parametrize("count", [1, 4, 9])
@pytest.mark.parametrize("n", [0, 1, 5000])
def test_colours(n: int, count: int) -> None:
    g = torch.Generator().manual_seed(count)
    sh, position, centre = torch.randn(n, count, 3, generator=g), torch.randn(n, 3, generator=g), torch.tensor([0.3, -2.0, 1.0])
    if n:
        position[0] = centre  # no direction
    weight = torch.randn(n, 3, generator=g)
    a, b = sh.clone().requires_grad_(), sh.double().requires_grad_()
    fast, slow = harmonics.colours(a, position, centre), harmonics.twin(b, position.double(), centre.double())
    (fast * weight).sum().backward()
    (slow * weight).sum().backward()
    assert torch.allclose(fast.double(), slow, atol=1e-5)
    assert a.grad is not None and b.grad is not None and torch.allclose(a.grad.double(), b.grad, atol=1e-5)


def test_basis_is_orthonormal_on_the_sphere() -> None:
    n = 20_000
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / n, i * torch.pi * (3 - 5**0.5)
    around = torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], 1)
    basis = []
    for k in range(9):
        sh = torch.zeros(n, 9, 3)
        sh[:, k] = 1
        basis.append(harmonics.colours(sh, around.float(), torch.zeros(3))[:, 0].double() - 0.5)
    product = torch.stack(basis) @ torch.stack(basis).T * 4 * torch.pi / n
    assert torch.allclose(product, torch.eye(9, dtype=torch.float64), atol=1e-3)
