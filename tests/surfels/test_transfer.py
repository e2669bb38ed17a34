"""The SDF → opacity transfers against their literal definitions in 60 digits, their inverses, derivatives and constants."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
import pytest
import torch

from gsbake.errors import BadInputError
from gsbake.surfels.adam import Adam
from gsbake.surfels.densification.clone_split import MIN_RELATIVE_OPACITY, prune
from gsbake.surfels.losses.terms import median_sharpness
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.transfer import TRANSFERS, Transfer, transfer_by_name

mp.mp.dps = 60
LAYER = mp.log(100)  # optical depth of VolSDF's layer on the zero set, and half the layer's thickness in 1/γ for NeuS


def logistic(x: Any) -> Any:
    return 1 / (1 + mp.exp(-x))


def laplace_cdf(x: Any) -> Any:
    return mp.exp(x) / 2 if x <= 0 else 1 - mp.exp(-x) / 2


def volsdf(s: Any, gamma: Any) -> Any:
    """Beer–Lambert through a layer of constant density γ Ψ(−γ|s|)."""
    return 1 - mp.exp(-gamma * laplace_cdf(-gamma * abs(s)) * (2 * LAYER / gamma))


def neus(s: Any, gamma: Any) -> Any:
    """NeuS eq. 13 between the faces of the layer."""
    entry, leave = logistic(gamma * (abs(s) + LAYER / gamma)), logistic(gamma * (abs(s) - LAYER / gamma))
    return max((entry - leave) / entry, 0)


LITERAL: dict[str, Callable[[Any, Any], Any]] = {
    "sech2": lambda s, gamma: 4 * mp.exp(-gamma * s) / (1 + mp.exp(-gamma * s)) ** 2,
    "bell": lambda s, gamma: mp.exp(-gamma * s) / (1 + mp.exp(-gamma * s)) ** 2,
    "gaussian": lambda s, gamma: mp.exp(-((gamma * s) ** 2)),
    "laplace": volsdf,
    "neus": neus,
}
each = pytest.mark.parametrize("transfer", TRANSFERS.values(), ids=list(TRANSFERS))
#: γ|s| from nothing to 1e4, through every elbow; times γ of both extremes
ARGUMENTS = [1e-6, 1e-3, 0.1, 0.5, 1.0, 2.0, 4.6, 5.0, 8.0, 20.0, 60.0, 87.0, 89.0, 104.0, 1e3, 1e4]
GAMMAS = [1e-3, 1.0, 4.549, 1e3]


@each
@pytest.mark.parametrize("gamma", GAMMAS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_and_derivatives_against_the_literal_definition(transfer: Transfer, gamma: float, dtype: torch.dtype) -> None:
    tolerance, rounding, tiny = (3e-5, 2e-7, 1e-36) if dtype == torch.float32 else (1e-11, 1e-15, 1e-280)
    literal = LITERAL[transfer.name]
    for sign in (-1, 1):
        s = (sign * torch.tensor(ARGUMENTS, dtype=torch.float64) / gamma).to(dtype).requires_grad_()
        g = torch.full_like(s, gamma, requires_grad=True)
        o = transfer.opacity(s, g)
        o.sum().backward()
        for i in range(len(ARGUMENTS)):
            si, gi = mp.mpf(float(s[i].detach())), mp.mpf(float(g[i].detach()))
            of_s = mp.diff(lambda v, gi=gi: literal(v, gi), si, h=abs(si) * mp.mpf("1e-25"))
            of_gamma = mp.diff(lambda v, si=si: literal(si, v), gi, h=gi * mp.mpf("1e-25"))
            # at the peak a slope is a difference of numbers of the peak's size: rounding counts in units of dx/ds = γ and dx/dγ = |s|
            near = rounding * (abs(si * gi) < 1)
            cases = ((o[i].detach(), literal(si, gi), 0), (s.grad[i], of_s, near * gi), (g.grad[i], of_gamma, near * abs(si)))
            for got, want, floor in cases:
                error = abs(mp.mpf(float(got)) - want)
                assert error <= tolerance * abs(want) + floor + tiny * (1 + gi + abs(si)), (ARGUMENTS[i], sign, float(got), float(want))


@each
@pytest.mark.parametrize("x", [0.0, 1e-30, 88.0, 1e4, -1e4, 1e12])
def test_finite_and_even_in_float32(transfer: Transfer, x: float) -> None:
    s = torch.tensor(x, requires_grad=True)
    gamma = torch.tensor(1.0, requires_grad=True)
    o = transfer.opacity(s, gamma)
    o.backward()
    assert torch.isfinite(s.grad) and torch.isfinite(gamma.grad)
    assert 0 <= float(o.detach()) <= transfer.peak + 1e-7
    assert float(o.detach()) == float(transfer.opacity(-s.detach(), gamma.detach()))


@each
def test_autograd_and_finite_differences_agree(transfer: Transfer) -> None:
    s = torch.tensor([0.3, -0.7, 2.0, -1e-2], dtype=torch.float64, requires_grad=True)
    gamma = torch.tensor([2.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(transfer.opacity, (s, gamma), eps=1e-7, atol=1e-7)
    alpha = (torch.tensor([0.01, 0.3, 0.8], dtype=torch.float64) * transfer.peak).requires_grad_()
    assert torch.autograd.gradcheck(transfer.distance, (alpha, gamma), eps=1e-8, atol=1e-5)


@each
def test_inverse(transfer: Transfer) -> None:
    """|s| → opacity → |s| and back, and the ends: nothing beyond the peak, finite at 0."""
    gamma = torch.tensor(3.0, dtype=torch.float64)
    alpha = transfer.peak * torch.tensor([1e-9, 1 / 255, 0.1, 0.5, 0.9, 0.999], dtype=torch.float64)
    s = transfer.distance(alpha, gamma)
    assert torch.all(s.diff() < 0)
    assert torch.allclose(transfer.opacity(s, gamma), alpha, rtol=1e-9, atol=0)
    assert torch.allclose(transfer.opacity(-s, gamma), alpha, rtol=1e-9, atol=0)
    ends = transfer.distance(torch.tensor([0.0, transfer.peak, 1.0]), gamma.float())
    assert torch.isfinite(ends).all() and ends[0] > 1 and float(ends[1:].abs().max()) < 1e-3


@each
def test_peak_and_decrease(transfer: Transfer) -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    assert float(transfer.opacity(0 * one, one)) == pytest.approx(transfer.peak, rel=1e-12)
    assert float(mp.mpf(LITERAL[transfer.name](mp.mpf(0), mp.mpf(1)))) == pytest.approx(transfer.peak, rel=1e-12)
    falling = transfer.opacity(torch.linspace(0, 20, 500, dtype=torch.float64), one)
    assert torch.all(falling.diff() < 0)


def test_published_table_of_sech2() -> None:
    """γ|s| at which o = .5, .1, .01, .005, 1/255."""
    sech2 = transfer_by_name("sech2")
    for o, x in ((0.5, 1.763), (0.1, 3.637), (0.01, 5.986), (0.005, 6.682), (1 / 255, 6.926)):
        assert float(sech2.distance(torch.tensor(o), torch.tensor(1.0))) == pytest.approx(x, abs=1e-3)
    assert sech2.half_width(0.5) == pytest.approx(1.7627, abs=1e-4)
    assert sech2.target_sharpness(0.01) == pytest.approx(4.549, abs=2e-3)


@each
def test_median_target_by_bisection(transfer: Transfer) -> None:
    """Half the peak at a wide median, .95 of it at .1 once the median is small: found here from the literal definition."""

    def gamma_with(share: float, s: float) -> float:
        low, high = 0.0, 1e3
        for _ in range(80):
            middle = (low + high) / 2
            value = LITERAL[transfer.name](mp.mpf(s), mp.mpf(middle))
            low, high = (middle, high) if value > share * transfer.peak else (low, middle)
        return low

    assert transfer.target_sharpness(0.4) == pytest.approx(gamma_with(0.5, 0.4), rel=1e-9)
    for median in (0.1, 0.01, 1e-6):
        assert transfer.target_sharpness(median) == pytest.approx(gamma_with(0.95, 0.1), rel=1e-9)
    sdf, gamma = torch.tensor([0.4, -0.4, 0.4, 9.0]), torch.tensor([0.25], requires_grad=True)
    loss = median_sharpness(sdf, gamma, transfer)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(gamma_with(0.5, 0.4) - 0.25, rel=1e-5) and float(gamma.grad) == -1


def ball(transfer: str, n: int = 40) -> Surfels:
    points = np.random.default_rng(0).normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return create(points, points, np.full(n, 0.1), None, "colour", 0, 0.05, 2.0, transfer)


@each
def test_the_transfer_follows_the_surfels(transfer: Transfer, tmp_path: Path) -> None:
    """Through selecting, joining and the file: later stages see the opacity of training."""
    surfels = ball(transfer.name)
    expected = float(LITERAL[transfer.name](mp.mpf("0.05"), mp.mpf(2)))
    some = surfels.select(torch.arange(10))
    assert all(torch.allclose(s.opacity(), torch.tensor(expected)) for s in (surfels, some, some.concat(surfels)))
    surfels.save(tmp_path / "surfels.safetensors")
    again = Surfels.load(tmp_path / "surfels.safetensors")
    assert again.transfer.name == transfer.name and torch.equal(again.opacity(), surfels.opacity())


def test_files_without_a_name_are_sech2_and_unknown_names_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    path = tmp_path / "s.safetensors"
    save_file(ball("sech2").tensors(), path)
    assert Surfels.load(path).transfer.name == "sech2"
    save_file(ball("sech2").tensors(), path, {"format": "gsbake surfels 1, quartic"})
    with pytest.raises(BadInputError, match="'quartic'"):
        Surfels.load(path)


@each
def test_pruning_is_relative_to_the_peak(transfer: Transfer) -> None:
    surfels = ball(transfer.name)
    limit = float(transfer.distance(torch.tensor(MIN_RELATIVE_OPACITY * transfer.peak), torch.tensor(2.0)))
    surfels.sdf[3], surfels.sdf[7] = 1.01 * limit, -1.01 * limit
    surfels.sdf[5] = 0.99 * limit
    _, kept, counts = prune(surfels, Adam(), None, math.inf)
    assert counts["transparent"] == 2 and set(range(40)) - set(kept.tolist()) == {3, 7}
