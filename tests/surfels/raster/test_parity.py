"""The Numba rasteriser against its float64 twin: every output, every gradient, the camera pose included."""

from __future__ import annotations

import math

import pytest
import torch

from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import render
from gsbake.surfels.raster.reference import render_reference

NAMES = ("position", "quaternion", "log_scale", "opacity", "features", "rotation", "translation")


def scene(n: int, seed: int, scale: float = 0.15, channels: int = 3) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    position = torch.randn(n, 3, generator=g, dtype=torch.float64) * 0.5
    quaternion = torch.randn(n, 4, generator=g, dtype=torch.float64)
    log_scale = math.log(scale) + 0.5 * torch.randn(n, 2, generator=g, dtype=torch.float64)
    opacity = 0.1 + 0.85 * torch.rand(n, generator=g, dtype=torch.float64)
    features = torch.rand(n, channels, generator=g, dtype=torch.float64)
    angle = torch.tensor(0.3, dtype=torch.float64)
    rotation = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=torch.float64)
    return [position, quaternion, log_scale, opacity, features, rotation, torch.tensor([0.05, -0.1, 3.0], dtype=torch.float64)]


VIEWS = [
    Pinhole(64, 48, 80.0, 80.0, 32.0, 24.0),
    Pinhole(37, 53, 60.0, 71.0, 11.3, 40.2),  # not multiples of the tile, off-centre, non-square pixels
    Pinhole(1, 1, 2.0, 2.0, 0.5, 0.5),
    Pinhole(16, 130, 40.0, 40.0, 8.0, 65.0),
]


def planes(out: object) -> dict[str, torch.Tensor]:
    names = ("features", "depth", "distortion", "alpha", "median")
    return {k: out[k] if isinstance(out, dict) else getattr(out, k) for k in names}


def both(inputs: list[torch.Tensor], view: Pinhole, weights_seed: int = 5):
    """Outputs and gradients of kernel and twin under the same random linear loss."""
    results = []
    g = torch.Generator().manual_seed(weights_seed)
    weights: dict[str, torch.Tensor] = {}
    for dtype in (torch.float32, torch.float64):
        leaves = [x.to(dtype).clone().requires_grad_() for x in inputs]
        out = planes(render(*leaves, view, normals_as_features=False) if dtype == torch.float32 else render_reference(*leaves, view))
        loss = torch.zeros((), dtype=dtype)
        for k in ("features", "depth", "distortion", "alpha"):
            if k not in weights:
                weights[k] = torch.randn(out[k].shape, generator=g, dtype=torch.float64)
            loss = loss + (out[k] * weights[k].to(dtype)).sum() * (100.0 if k == "distortion" else 1.0)
        if loss.requires_grad:
            loss.backward()
        grads = [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]
        # a rotation matrix moves only along its tangent space (the kernel takes N = T x B there): compare the turning moment
        turn = grads[5] @ leaves[5].detach().T
        grads[5] = turn - turn.T
        results.append(({k: v.detach() for k, v in out.items()}, grads))
    return results


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_outputs_and_gradients(view: Pinhole, seed: int) -> None:
    (fast, fast_grads), (slow, slow_grads) = both(scene(40, seed), view)
    for k in fast:
        # a surfel exactly at a threshold may fall on either side in float32: allow a handful of such pixels
        error = (fast[k].double() - slow[k]).abs()
        assert error.median() < 1e-5 * max(1.0, float(slow[k].abs().max())), k
        assert (error > 2e-4 * max(1.0, float(slow[k].abs().max()))).double().mean() < 0.01, k
    for name, a, b in zip(NAMES, fast_grads, slow_grads, strict=True):
        assert (a.double() - b).norm() < 0.02 * b.norm() + 1e-4, name


def test_smooth_scene_gradients_agree_closely() -> None:
    """Large soft surfels inside the frame: few threshold pixels, so the gradients agree to float32 accuracy."""
    inputs = scene(6, 7, scale=0.4)
    inputs[3] = inputs[3] * 0.5
    (_, fast), (_, slow) = both(inputs, Pinhole(40, 40, 60.0, 60.0, 20.0, 20.0))
    for name, a, b in zip(NAMES, fast, slow, strict=True):
        assert (a.double() - b).norm() < 2e-3 * b.norm() + 1e-5, name


def test_nothing_to_draw() -> None:
    inputs = [x.float() for x in scene(0, 0)]
    out = render(*inputs, VIEWS[0], normals_as_features=False)
    assert out.alpha.abs().sum() == 0 and out.features.shape == (3, 48, 64)


@pytest.mark.parametrize("z", [-1.0, 0.0, 0.02, 1e-6])
def test_behind_and_at_the_camera(z: float) -> None:
    """Surfels behind, at and across the near plane neither crash nor leave a NaN."""
    inputs = [x.float() for x in scene(5, 3, scale=2.0)]
    inputs[0][:, 2] = z
    inputs[5], inputs[6] = torch.eye(3), torch.zeros(3)
    leaves = [x.requires_grad_() for x in inputs]
    out = render(*leaves, VIEWS[0], normals_as_features=False)
    loss = out.features.sum() + out.depth.sum() + out.distortion.sum()
    loss.backward()
    assert torch.isfinite(loss.detach())
    assert all(torch.isfinite(x.grad).all() for x in leaves)


def test_opaque_surfel_hides_what_lies_behind() -> None:
    """One opaque frontal surfel: alpha .99 at the centre, its depth, its colour."""
    q = torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])
    position = torch.tensor([[0.0, 0, 2.0], [0.0, 0, 4.0]])
    colour = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]])
    view = Pinhole(33, 33, 30.0, 30.0, 16.5, 16.5)
    out = render(position, q, torch.full((2, 2), math.log(0.3)), torch.ones(2), colour, torch.eye(3), torch.zeros(3), view, False)
    assert out.alpha[16, 16] == pytest.approx(0.99 + 0.01 * 0.99, abs=1e-5)
    assert out.median[16, 16] == pytest.approx(2.0)
    assert out.features[0, 16, 16] == pytest.approx(0.99, abs=1e-5)
    assert out.features[1, 16, 16] == pytest.approx(0.01 * 0.99, abs=1e-5)


def test_threads_do_not_change_a_bit() -> None:
    inputs = [x.float() for x in scene(300, 9, scale=0.05)]
    images = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            leaves = [x.clone().requires_grad_() for x in inputs]
            out = render(*leaves, VIEWS[0], normals_as_features=False)
            out.features.sum().backward()
            images.append([out.features.detach(), *(x.grad for x in leaves)])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*images, strict=True))
