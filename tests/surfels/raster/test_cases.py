"""Hard cases against the float64 twin, and the twin itself against finite differences: every input, the camera's pose included."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from numba.core.dispatcher import Dispatcher
from torch import Tensor

from gsbake.surfels.raster.kernel import backward_kernel, forward_kernel
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import render
from gsbake.surfels.raster.reference import render_reference

PLANES = ("features", "depth", "distortion", "alpha", "median")
NAMES = ("position", "quaternion", "log_scale", "opacity", "features", "rotation", "translation")
VIEW = Pinhole(45, 37, 50.0, 61.0, 19.2, 21.7)  # no multiple of the tile, off-centre, non-square pixels


def scene(n: int, seed: int, scale: float, opacity: float | None = None) -> list[Tensor]:
    """n surfels around z = 3 before a camera at the origin, float64."""
    g = torch.Generator().manual_seed(seed)
    position = torch.randn(n, 3, generator=g, dtype=torch.float64) * 0.4 + torch.tensor([0, 0, 3.0], dtype=torch.float64)
    quaternion = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64) + 0.3 * torch.randn(n, 4, generator=g, dtype=torch.float64)
    log_scale = math.log(scale) + 0.2 * torch.randn(n, 2, generator=g, dtype=torch.float64)
    o = 0.2 + 0.6 * torch.rand(n, generator=g, dtype=torch.float64) if opacity is None else torch.full((n,), opacity, dtype=torch.float64)
    features = torch.rand(n, 3, generator=g, dtype=torch.float64)
    return [position, quaternion, log_scale, o, features, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)]


def behind(x: list[Tensor]) -> None:
    x[0][::2, 2] *= -1


def at_the_near_plane(x: list[Tensor]) -> None:
    x[0][:, 2] = torch.linspace(0.0, 0.06, len(x[0]))
    x[0][:, :2] *= 0.02
    x[2] -= 5.0


def across_the_camera_plane(x: list[Tensor]) -> None:
    x[0][:, 2] = 0.5
    x[1][:] = torch.tensor([1.0, 0.0, 0.9, 0.1])  # turned by about 84°: the disc reaches behind the camera
    x[2][:] = math.log(0.6)


def edge_on(x: list[Tensor]) -> None:
    x[1][:] = torch.tensor([1.0, 0.0, 1.0, 0.0])
    x[1][:, 0] += torch.linspace(-3e-2, 3e-2, len(x[0]))


def tiny(x: list[Tensor]) -> None:
    x[2][:] = torch.linspace(math.log(1e-8), math.log(0.01), len(x[0]))[:, None]


def huge(x: list[Tensor]) -> None:
    x[2][:] = torch.linspace(0.0, math.log(1e4), len(x[0]))[:, None]
    x[3] *= 0.5


def coincident(x: list[Tensor]) -> None:
    for i in (0, 1, 2):
        x[i][1::2] = x[i][::2]
    x[0][:4] = x[0][0]


def opaque(x: list[Tensor]) -> None:
    x[3][:] = 1.0


def needles(x: list[Tensor]) -> None:
    x[2][:, 0] += 3.0
    x[2][:, 1] -= 4.0


CASES = (behind, at_the_near_plane, across_the_camera_plane, edge_on, tiny, huge, coincident, opaque, needles)


@pytest.mark.parametrize("view", [VIEW, Pinhole(33, 70, 90.0, 20.0, -4.0, 80.0)], ids=["inside", "principal point outside"])
@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_hard_cases(case: Callable[[list[Tensor]], None], view: Pinhole) -> None:
    inputs = scene(16, 11, 0.2)
    case(inputs)
    leaves = [x.float().requires_grad_() for x in inputs]
    out = render(*leaves, view, normals_as_features=False)
    with torch.no_grad():
        twin = render_reference(*inputs, view)
    for k in PLANES:
        fast, slow = getattr(out, k).detach().double(), twin[k]
        error = (fast - slow).abs() / max(1.0, float(slow.abs().max()))
        # a surfel at a threshold (1/255, the low-pass switch, edge-on) may fall on either side in float32
        assert error.median() < 1e-5 and (error > 1e-3).double().mean() < 0.01, (k, float(error.max()))
    (out.features.sum() + out.depth.sum() + out.distortion.sum() + out.alpha.sum()).backward()
    assert all(x.grad is not None and torch.isfinite(x.grad).all() for x in leaves)


def test_cases_draw_something() -> None:
    """The comparison above is of pictures, not of empty frames."""
    for case in CASES:
        inputs = scene(16, 11, 0.2)
        case(inputs)
        with torch.no_grad():
            assert render_reference(*inputs, VIEW)["alpha"].max() > 0.05, case.__name__


def smooth() -> tuple[list[Tensor], Pinhole]:
    """Wide, soft surfels that cover a small frame: no pixel near a threshold, so everything is differentiable."""
    inputs = scene(3, 4, 1.5)
    inputs[3] = inputs[3] * 0.6
    return inputs, Pinhole(7, 5, 9.0, 8.0, 3.1, 2.8)


def test_the_twin_by_gradcheck() -> None:
    inputs, view = smooth()
    leaves = [x.clone().requires_grad_() for x in inputs]

    def planes(*x: Tensor) -> tuple[Tensor, ...]:
        out = render_reference(*x, view)
        return out["features"], out["depth"], out["distortion"], out["alpha"]

    assert torch.autograd.gradcheck(planes, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_kernel_gradients_by_finite_differences(name: str) -> None:
    """Along random directions of each input; the camera turns along its tangent space."""
    inputs, view = smooth()
    g = torch.Generator().manual_seed(8)
    which = NAMES.index(name)
    with torch.no_grad():
        shapes = render_reference(*inputs, view)
    weights = {k: torch.randn(shapes[k].shape, generator=g, dtype=torch.float64) for k in ("features", "depth", "distortion", "alpha")}
    weights["distortion"] *= 300

    def loss(out: dict[str, Tensor]) -> Tensor:
        return torch.stack([(out[k] * w.to(out[k].dtype)).sum() for k, w in weights.items()]).sum()

    leaves = [x.float().requires_grad_() for x in inputs]
    out = render(*leaves, view, normals_as_features=False)
    loss({k: getattr(out, k) for k in weights}).backward()
    gradient = leaves[which].grad
    assert gradient is not None
    for _ in range(5):
        step = torch.randn(inputs[which].shape, generator=g, dtype=torch.float64)
        ends = []
        for sign in (1, -1):
            moved = list(inputs)
            if name == "rotation":
                turn = sign * 1e-5 * (step - step.T)
                moved[which] = torch.linalg.matrix_exp(turn) @ inputs[which]
            else:
                moved[which] = inputs[which] + sign * 1e-5 * step
            ends.append(float(loss(render_reference(*moved, view))))
        if name == "rotation":
            step = (step - step.T) @ inputs[which]
        slope = (ends[0] - ends[1]) / 2e-5
        bound = 2e-3 * float(gradient.double().norm() * step.norm())
        assert float((gradient.double() * step).sum()) == pytest.approx(slope, abs=bound + 1e-4)


@pytest.mark.parametrize("made", [forward_kernel, backward_kernel])
def test_kernels_can_be_found_in_the_cache(made: Callable[[int], Any]) -> None:
    """A compiled function among a kernel's closure variables would make it a new kernel, to compile for seconds, in every process."""
    (kernel,) = (cell.cell_contents for cell in made(3).__closure__)  # type: ignore[attr-defined]
    closure = [cell.cell_contents for cell in kernel.py_func.__closure__]
    assert len(closure) > 5 and not any(isinstance(x, Dispatcher) for x in closure)
