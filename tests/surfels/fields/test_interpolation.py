"""Multilinear interpolation against its PyTorch twin: value, Jacobian and gradients, for every kind of level."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbake.surfels.fields.interpolation import interpolate
from gsbake.surfels.fields.interpolation_reference import corner_rows, interpolate_reference
from gsbake.surfels.fields.levels import BLOCKS, CORNERS, DENSE, HASHED, Level, Levels

LOWER, UPPER = np.array([-1, -0.5, 0], np.float32), np.array([1, 1.5, 1], np.float32)


def some(shape: tuple[int, ...], rows: int) -> np.ndarray:
    """An index table with gaps."""
    index = np.full(int(np.prod(shape)), -1, np.int32)
    index[np.random.default_rng(0).permutation(len(index))[:rows]] = np.arange(rows)
    return index.reshape(shape)


LEVELS = {
    "dense": (Level((4, 5, 3), DENSE, 60),),
    "hashed": (Level((40, 50, 30), HASHED, 64),),
    "corners": (Level((4, 5, 3), CORNERS, 40, some((4, 5, 3), 40)),),
    "blocks": (Level((17, 17, 9), BLOCKS, 512 * 5, some((3, 3, 2), 5)),),
    "plane and line": (Level((4, 5, 1), DENSE, 20), Level((1, 1, 7), DENSE, 7)),
    "all": (Level((4, 5, 3), DENSE, 60), Level((40, 50, 30), HASHED, 64), Level((4, 5, 3), CORNERS, 40, some((4, 5, 3), 40))),
}


def points(count: int = 300) -> torch.Tensor:
    """Inside, outside and on corners of the box."""
    g = torch.Generator().manual_seed(0)
    x = torch.from_numpy(LOWER) + torch.from_numpy(UPPER - LOWER) * (1.2 * torch.rand(count, 3, generator=g) - 0.1)
    x[0], x[1] = torch.from_numpy(LOWER), torch.from_numpy(UPPER)
    return x


@pytest.mark.parametrize("kind", LEVELS)
def test_kernel_equals_its_twin(kind: str) -> None:
    levels = Levels(LOWER, UPPER, LEVELS[kind])
    g = torch.Generator().manual_seed(1)
    table = torch.randn(levels.rows, 2, generator=g)
    weights = [torch.randn(300, 2 * len(levels.levels), generator=g), torch.randn(300, 3, 2 * len(levels.levels), generator=g)]
    results = []
    for function, dtype in ((interpolate, torch.float32), (interpolate_reference, torch.float64)):
        x, t = points().to(dtype).requires_grad_(), table.detach().clone().to(dtype).requires_grad_()
        out, jacobian = function(x, t, levels)
        loss = (out * weights[0]).sum()
        (loss + (jacobian * weights[1]).sum()).backward()
        results.append((out, jacobian, t.grad, x.grad))
    # a point on a cell's face may fall on either side of it: its Jacobian may be that of either cell
    for mine, twin in zip(results[0], results[1], strict=True):
        assert torch.allclose(mine.double(), twin, atol=2e-3, rtol=1e-4)


@pytest.mark.parametrize("kind", LEVELS)
def test_jacobian_agrees_with_differences(kind: str) -> None:
    levels = Levels(LOWER, UPPER, LEVELS[kind])
    table = torch.randn(levels.rows, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x = points()[2:].double()
    h = 1e-7
    jacobian = interpolate_reference(x, table, levels)[1]
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = h
        numeric = (interpolate_reference(x + step, table, levels)[0] - interpolate_reference(x - step, table, levels)[0]) / (2 * h)
        assert torch.allclose(jacobian[:, axis], numeric, atol=1e-5)


@pytest.mark.slow
def test_gradients_of_the_table_agree_with_differences() -> None:
    levels = Levels(LOWER, UPPER, LEVELS["all"])
    table = torch.randn(levels.rows, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: interpolate_reference(points(12).double(), t, levels), (table,))


def test_a_linear_function_is_exact() -> None:
    size = (4, 5, 3)
    axes = [np.linspace(a, b, n) for a, b, n in zip(LOWER, UPPER, size, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    slope = np.array([0.3, -2.0, 1.5])
    levels = Levels(LOWER, UPPER, (Level(size, DENSE, 60),))
    inside = torch.from_numpy(np.random.default_rng(0).uniform(LOWER, UPPER, (100, 3)).astype(np.float32))
    out, jacobian = interpolate(inside, torch.from_numpy((grid @ slope + 1).astype(np.float32))[:, None], levels)
    assert torch.allclose(out[:, 0], inside @ torch.from_numpy(slope).float() + 1, atol=1e-5)
    assert torch.allclose(jacobian[:, :, 0], torch.from_numpy(slope).float().expand(100, 3), atol=1e-4)


def test_the_hash_is_that_of_the_paper() -> None:
    # (x · 1) xor (y · 2654435761) xor (z · 805459861), 32 bits, modulo the rows
    level = Level((10, 10, 10), HASHED, 1000)
    expected = (3 ^ (4 * 2_654_435_761 % 2**32) ^ (5 * 805_459_861 % 2**32)) % 1000
    assert corner_rows(level, torch.tensor([[3, 4, 5]])).tolist() == [expected]


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_points_that_are_not_finite_stay_in_the_box(bad: float) -> None:
    levels = Levels(LOWER, UPPER, LEVELS["all"])
    out, jacobian = interpolate(torch.full((5, 3), bad), torch.ones(levels.rows, 2), levels)
    assert torch.isfinite(out).all() and torch.isfinite(jacobian).all()
