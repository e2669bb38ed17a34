"""Renders and gradients of extreme scenes are finite."""

from __future__ import annotations

import pytest
import torch
from hypothesis import HealthCheck, given, settings

from gsbake.surfels.finite import first_non_finite
from tests.stress.scenes import Scene, build, scenes


def check(scene: Scene) -> None:
    out = scene.render()
    planes = {k: getattr(out, k) for k in ("features", "depth", "distortion", "alpha", "median")}
    assert first_non_finite(planes) is None
    assert float(out.alpha.detach().min() if out.alpha.numel() else 0) >= 0
    assert float(out.alpha.detach().max()) <= 1
    gradients = scene.backward(out)
    assert first_non_finite(gradients) is None
    assert first_non_finite(out.stats) is None


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(scenes())
def test_render_and_gradients_are_finite(scene: Scene) -> None:
    check(scene)


@pytest.mark.stress
@pytest.mark.timeout(0)
@settings(max_examples=3000, deadline=None, suppress_health_check=list(HealthCheck))
@given(scenes())
def test_render_and_gradients_are_finite_in_many_scenes(scene: Scene) -> None:
    check(scene)


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_opacity_limits(opacity: float) -> None:
    """Opacity is exactly 0 for large s and, with the default transfer function, exactly 1 at s = 0."""
    scene = build(20, 1, (-1, 0), 0.3, 3.0, 10.0, "sech2", 50.0, (33, 20))
    with torch.no_grad():
        scene.leaves["sdf"][:] = 0.0 if opacity else 1e6
    assert (scene.transfer.opacity(scene.leaves["sdf"], scene.leaves["gamma"]) == opacity).all()
    check(scene)
    assert (scene.render().alpha.max() > 0.9) == bool(opacity)


@pytest.mark.stress
@pytest.mark.timeout(0)
def test_one_million_surfels() -> None:
    check(build(1_000_000, 3, (-3, -2), 0.5, 3.0, 20.0, "sech2", 45.0, (800, 800)))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["position", "quaternion", "log_scale", "sdf", "gamma"])
def test_surfels_that_are_not_finite_are_not_rendered(name: str, bad: float) -> None:
    """A surfel whose geometry or opacity is not finite is skipped; the image stays finite. (Training raises, see test_training.)"""
    scene = build(12, 2, (-1, -0.5), 0.3, 3.0, 5.0, "sech2", 50.0, (33, 20))
    with torch.no_grad():
        scene.leaves[name].view(-1)[0] = bad
    out = scene.render()
    assert first_non_finite({"features": out.features[:3], "depth": out.depth, "alpha": out.alpha}) is None


def test_render_and_gradients_are_deterministic() -> None:
    def run() -> list[torch.Tensor]:
        scene = build(60, 5, (-2, 0), 0.5, 3.0, 5.0, "neus", 60.0, (33, 50))
        out = scene.render()
        return [out.features.detach(), *scene.backward(out).values()]

    assert all(torch.equal(a, b) for a, b in zip(run(), run(), strict=True))
