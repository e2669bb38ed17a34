"""Whatever the scene, what is rendered and its gradients are finite; what is not finite is named, not passed on."""

from __future__ import annotations

import pytest
import torch
from hypothesis import HealthCheck, given, settings

from gsbake.surfels.training.finite import broken
from tests.stress.scenes import Scene, build, scenes


def check(scene: Scene) -> None:
    out = scene.render()
    planes = {k: getattr(out, k) for k in ("features", "depth", "distortion", "alpha", "median")}
    assert broken(planes) is None
    assert float(out.alpha.detach().min() if out.alpha.numel() else 0) >= 0
    assert float(out.alpha.detach().max()) <= 1
    gradients = scene.backward(out)
    assert broken(gradients) is None
    assert broken(out.stats) is None


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(scenes())
def test_finite(scene: Scene) -> None:
    check(scene)


@pytest.mark.stress
@pytest.mark.timeout(0)
@settings(max_examples=3000, deadline=None, suppress_health_check=list(HealthCheck))
@given(scenes())
def test_finite_at_length(scene: Scene) -> None:
    check(scene)


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_opacity_at_its_ends(opacity: float) -> None:
    """s far away and s = 0 give exactly 0 and, for the default transfer, exactly 1."""
    scene = build(20, 1, (-1, 0), 0.3, 3.0, 10.0, "sech2", 50.0, (33, 20))
    with torch.no_grad():
        scene.leaves["sdf"][:] = 0.0 if opacity else 1e6
    assert (scene.transfer.opacity(scene.leaves["sdf"], scene.leaves["gamma"]) == opacity).all()
    check(scene)
    assert (scene.render().alpha.max() > 0.9) == bool(opacity)


@pytest.mark.stress
@pytest.mark.timeout(0)
def test_a_million_surfels() -> None:
    check(build(1_000_000, 3, (-3, -2), 0.5, 3.0, 20.0, "sech2", 45.0, (800, 800)))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["position", "quaternion", "log_scale", "sdf", "gamma"])
def test_a_bad_surfel_is_not_drawn(name: str, bad: float) -> None:
    """A surfel whose geometry or opacity is not finite disappears; the picture stays finite. (Training names it, see test_training.)"""
    scene = build(12, 2, (-1, -0.5), 0.3, 3.0, 5.0, "sech2", 50.0, (33, 20))
    with torch.no_grad():
        scene.leaves[name].view(-1)[0] = bad
    out = scene.render()
    assert broken({"features": out.features[:3], "depth": out.depth, "alpha": out.alpha}) is None


def test_same_bits_again() -> None:
    def run() -> list[torch.Tensor]:
        scene = build(60, 5, (-2, 0), 0.5, 3.0, 5.0, "neus", 60.0, (33, 50))
        out = scene.render()
        return [out.features.detach(), *scene.backward(out).values()]

    assert all(torch.equal(a, b) for a, b in zip(run(), run(), strict=True))
