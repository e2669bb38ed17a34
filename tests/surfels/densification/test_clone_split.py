"""Clone, split and prune: budget, inherited attributes, Adam's moments, files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gsbake.surfels.adam import Adam
from gsbake.surfels.densification.clone_split import Statistics, densify, prune, reset_opacity
from gsbake.surfels.densification.policy import PolicyInputs
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create, quaternion_from_normal


def ball(n: int = 200, shading: str = "colour") -> Surfels:
    points = fibonacci_sphere(n)
    return create(points, points, spacing(points), np.full((n, 3), 0.25), shading, 1, 0.01, 1.0)


def test_create_and_reload(tmp_path: Path) -> None:
    for shading in ("colour", "pbr"):
        s = ball(50, shading)
        assert torch.allclose(s.normal(), s.position, atol=1e-5)
        colour = s.features(torch.tensor([0.0, 0.0, 5.0]))[:, :3]
        expected = 0.25 if shading == "colour" else ((0.25 + 0.055) / 1.055) ** 2.4  # sRGB .25 → linear
        assert torch.allclose(colour, torch.full_like(colour, expected), atol=1e-4)
        s.save(tmp_path / "s.safetensors")
        again = Surfels.load(tmp_path / "s.safetensors")
        assert all(torch.equal(v, again.tensors()[k]) for k, v in s.tensors().items())


def test_quaternions_turn_z_to_the_normal() -> None:
    n = torch.nn.functional.normalize(torch.randn(100, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    n[0], n[1] = torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 0.0, 1.0])
    s = ball(100)
    s.quaternion = quaternion_from_normal(n)
    assert torch.allclose(s.normal(), n, atol=1e-5)


def test_densify_respects_the_budget_and_keeps_moments() -> None:
    s, adam = ball(), Adam()
    for name, x in s.tensors().items():
        adam.step(name, x, torch.ones_like(x), 1e-3)
    score = torch.zeros(200)
    score[:30] = 5.0
    s.sdf = torch.arange(200) / 1000.0
    before = s.scale.clone()
    big = densify(s, adam, score, 220, large=0.0, generator=torch.Generator().manual_seed(0))
    assert len(big) == 220
    assert torch.all(big.sdf[200:] < 0.03)  # children inherit s, and only surfels with a score were chosen
    assert adam.first["position"].shape == (220, 3) and torch.all(adam.first["position"][200:] == 0)
    parents = torch.round(big.sdf[200:] * 1000).long()
    assert torch.allclose(big.scale[200:], before[parents] / 1.6) and torch.allclose(big.scale[parents], before[parents] / 1.6)
    assert densify(big, adam, torch.zeros(220), 300, 0.0, torch.Generator()) is big  # scores of 0 are not densified


def test_prune_reasons() -> None:
    s, adam = ball(), Adam()
    s.sdf[3] = 50.0
    s.log_scale[5] = 2.0
    s.position[7] = float("nan")
    stats = Statistics.zeros(200)
    stats.views[:], stats.weight[:] = 2, 10.0
    stats.views[9], stats.weight[9] = 0, 0.0
    stats.weight[11] = 0.01  # occluded
    kept, index, counts = prune(s, adam, stats, 0.25)
    assert len(kept) == 195 and set(range(200)) - set(index.tolist()) == {3, 5, 7, 9, 11}
    assert counts == {"transparent": 1, "too large": 1, "not finite": 1, "unseen": 2}


def test_prune_removes_surfels_off_the_surface() -> None:
    s, adam = ball(), Adam()
    s.sdf[3] = 50.0  # transparent and off the surface
    off = torch.zeros(200, dtype=torch.bool)
    off[[3, 8]] = True
    kept, index, counts = prune(s, adam, None, 0.25, off)
    assert len(kept) == 198 and set(range(200)) - set(index.tolist()) == {3, 8}
    assert counts == {"transparent": 1, "too large": 0, "not finite": 0, "off the surface": 2}


def test_policy_inputs_take_the_spacing_from_the_scales() -> None:
    s = ball()
    s.sdf[0], s.sdf[1] = -0.2, 0.1
    at = PolicyInputs.from_surfels(s, s.sdf)
    assert at.spacing == pytest.approx(float(np.median(spacing(s.position.numpy().astype(float)))), rel=1e-3)
    assert torch.allclose(at.distance[:3], torch.tensor([0.2, 0.1, 0.01])) and at.max_distance == pytest.approx(3 * at.spacing)
    assert float(at.opacity[0]) == pytest.approx(1 / np.cosh(0.1) ** 2, rel=1e-5)  # sech²(γs/2), γ = 1
    empty = s.select(torch.zeros(0, dtype=torch.long))
    assert PolicyInputs.from_surfels(empty, empty.sdf).distance.shape == (0,)


def test_adam_follows_the_paper() -> None:
    """Two steps by hand (Kingma and Ba 2015, algorithm 1)."""
    adam, x = Adam(), torch.tensor([1.0])
    adam.step("x", x, torch.tensor([2.0]), 0.1)
    assert torch.allclose(x, torch.tensor([0.9]))
    adam.step("x", x, torch.tensor([-1.0]), 0.1)
    m, v = 0.9 * 0.1 * 2 + 0.1 * -1, 0.999 * 0.001 * 4 + 0.001 * 1
    expected = 0.9 - 0.1 * (m / (1 - 0.81)) / (v / (1 - 0.999**2)) ** 0.5
    assert torch.allclose(x, torch.tensor([expected], dtype=torch.float32))


def test_reset_opacity_moves_surfels_off_the_surface_but_not_the_surface() -> None:
    s = ball(200)
    s.gamma = torch.tensor([50.0])
    s.sdf = torch.linspace(-0.1, 0.1, 200)
    surface, far = s.position - s.sdf[:, None] * s.normal(), s.sdf.abs() > 0.04
    before = s.sdf.clone()
    count = reset_opacity(s, 0.5)
    assert count == int((before.abs() < s.transfer.half_width(0.5) / 50).sum()) > 20
    assert float(s.opacity().max()) < 0.5 + 1e-5
    assert torch.allclose(s.position - s.sdf[:, None] * s.normal(), surface, atol=1e-6)
    assert torch.equal(s.sdf[far], before[far]) and torch.equal(s.sdf < 0, before < 0)


def test_surfels_with_an_opacity_of_their_own_are_left_alone() -> None:
    s = ball(10)
    s.attributes["opacity"] = torch.full((10,), 2.0)
    assert reset_opacity(s, 0.5) == 0 and s.peak_opacity == 1.0
    assert torch.allclose(s.opacity(), torch.sigmoid(torch.tensor(2.0)).expand(10))
