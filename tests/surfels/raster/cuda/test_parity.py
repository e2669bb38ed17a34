"""The Triton kernels, interpreted on the CPU, against the Numba kernels and the float64 twin: every plane and every gradient."""

from __future__ import annotations

import math

import pytest
import torch

from gsbake.surfels.raster.binning import bin_surfels as bin_numba
from gsbake.surfels.raster.cuda import kernels
from gsbake.surfels.raster.cuda.binning import bin_surfels
from gsbake.surfels.raster.cuda.projection import project
from gsbake.surfels.raster.projection import Pinhole, Project
from gsbake.surfels.raster.rasterise import Rendered, render
from gsbake.surfels.raster.reference import render_reference

NAMES = ("position", "quaternion", "log_scale", "opacity", "features", "rotation", "translation")
PLANES = ("features", "depth", "distortion", "alpha")
SHIPPED = dict(kernels.BACKWARD)
VIEW = Pinhole(37, 29, 40.0, 44.0, 17.3, 15.2)  # not multiples of the tile, off-centre, non-square pixels


@pytest.fixture(autouse=True)
def long_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter's time goes by the number of operations, whatever their width."""
    monkeypatch.setattr(kernels, "BACKWARD", {"CHUNK": 32, "num_warps": 4})


def scene(n: int, seed: int, scale: float, channels: int = 5) -> list[torch.Tensor]:
    """A cloud of surfels three units before the camera, float32."""
    g = torch.Generator().manual_seed(seed)
    angle = 0.3
    rotation = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    return [
        torch.randn(n, 3, generator=g) * 0.5, torch.randn(n, 4, generator=g), math.log(scale) + 0.5 * torch.randn(n, 2, generator=g),
        0.1 + 0.85 * torch.rand(n, generator=g), torch.rand(n, channels, generator=g),
        torch.tensor(rotation), torch.tensor([0.05, -0.1, 3.0]),
    ]  # fmt: skip


def awkward(seed: int = 1) -> list[torch.Tensor]:
    """Surfels edge-on, behind, at and across the near plane, tiny, huge, coincident, opaque and faint among ordinary ones."""
    inputs = scene(120, seed, 0.1)
    position, quaternion, log_scale, opacity, _, rotation, translation = inputs
    to_world = lambda c: (torch.tensor(c) - translation) @ rotation  # noqa: E731 (from camera coordinates)
    position[0], position[1] = to_world([0.1, 0.0, -1.0]), to_world([0.0, 0.1, 0.0])
    position[2], position[3] = to_world([0.0, 0.0, 0.02]), to_world([0.005, 0.0, 0.021])
    log_scale[2:4] = 0.0
    half = math.sqrt(0.5)
    position[4] = to_world([0.0, 0.0, 2.0])  # edge-on: its tangent plane holds the camera
    quaternion[4] = torch.tensor([math.cos(-0.15), 0.0, math.sin(-0.15), 0.0])
    quaternion[4] = torch.tensor([half * quaternion[4, 0], half * quaternion[4, 0], half * quaternion[4, 2], -half * quaternion[4, 2]])
    log_scale[5:10] = math.log(1e-6)
    log_scale[10:12] = math.log(300.0)
    position[10:12, 2] += 1.0
    log_scale[12], log_scale[13, 0], log_scale[14], quaternion[15] = 100.0, -100.0, -100.0, 0.0
    for x in (position, quaternion, log_scale):
        x[20:26] = x[20].clone()
    position[30:34] = position[30].clone()  # one centre, four orientations
    opacity[20:22], opacity[40:60], opacity[60], opacity[61] = 1.0, 1.0, 1.0 / 255.0, 0.0
    return inputs


def grads_of(inputs: list[torch.Tensor], view: Pinhole, triton: bool, **options: bool) -> tuple[Rendered, list[torch.Tensor]]:
    leaves = [x.clone().requires_grad_() for x in inputs]
    out = render(*leaves, view, triton=triton, **options)
    g = torch.Generator().manual_seed(5)
    loss = torch.zeros(())
    for name in PLANES:
        plane = getattr(out, name)
        loss = loss + (plane * torch.randn(plane.shape, generator=g)).sum() * (100.0 if name == "distortion" else 1.0)
    loss.backward()
    return out, [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]


def compare(inputs: list[torch.Tensor], view: Pinhole, **options: bool) -> None:
    (numba, numba_grads), (triton, triton_grads) = (grads_of(inputs, view, kind, **options) for kind in (False, True))
    assert torch.equal(numba.visible, triton.visible)
    for name in (*PLANES, "median"):
        a, b = getattr(numba, name).detach(), getattr(triton, name).detach()
        error, size = (a - b).abs(), float(a.abs().max())
        assert torch.isfinite(b).all() and float(error.median()) <= 1e-6 * size + 1e-9, name
        # a surfel exactly at a threshold (1/255, plane or disc, T = 1/2) may fall on either side
        assert float((error > 5e-5 * size + 1e-7).float().mean()) < 0.01, name
    for name, a, b in zip(NAMES, numba_grads, triton_grads, strict=True):
        assert torch.isfinite(b).all() and float((a - b).norm()) <= 2e-3 * float(a.norm()) + 1e-5, name
    touched = numba.stats["weight"]
    assert torch.allclose(triton.stats["weight"], touched, rtol=1e-3, atol=1e-3 * float(touched.max()))
    assert numba.projected.grad is not None and triton.projected.grad is not None
    assert float((numba.projected.grad - triton.projected.grad).norm()) <= 2e-3 * float(numba.projected.grad.norm())


@pytest.mark.parametrize("seed", [0, 1])
def test_awkward_surfels(seed: int) -> None:
    compare(awkward(seed), VIEW)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (5, 40)])
def test_frames(width: int, height: int) -> None:
    compare(scene(40, 2, 0.15), Pinhole(width, height, 30.0, 30.0, width / 2, height / 2))


def test_many_small_surfels() -> None:
    """Long lists, several chunks a tile, tiles that fill up before their list ends."""
    inputs = scene(400, 3, 0.08)
    inputs[3][:] = 0.95
    compare(inputs, VIEW, cull_backfaces=True)


@pytest.mark.parametrize(
    ("inputs", "view"),
    [
        (scene(6, 7, 0.4), Pinhole(40, 30, 60.0, 60.0, 20.0, 15.0)),
        (scene(5, 4, 0.4, channels=17), Pinhole(12, 10, 18.0, 18.0, 6.0, 5.0)),  # more features than one block of the matrix product holds
    ],
)
def test_against_the_float64_twin(inputs: list[torch.Tensor], view: Pinhole) -> None:
    """Large soft surfels, few threshold pixels: gradients to float32 accuracy against the independent formulation."""
    inputs[3] *= 0.5
    triton, grads = grads_of(inputs, view, True, normals_as_features=False)
    leaves = [x.double().requires_grad_() for x in inputs]
    twin = render_reference(*leaves, view)
    g = torch.Generator().manual_seed(5)
    loss = torch.zeros((), dtype=torch.float64)
    for k in PLANES:
        loss = loss + (twin[k] * torch.randn(twin[k].shape, generator=g)).sum() * (100.0 if k == "distortion" else 1.0)
    loss.backward()
    for k in (*PLANES, "median"):
        assert torch.allclose(getattr(triton, k).detach().double(), twin[k].detach(), atol=2e-5), k
    for name, grad, leaf in zip(NAMES, grads, leaves, strict=True):
        ours, theirs = grad.double(), leaf.grad
        assert theirs is not None
        if name == "rotation":  # it moves only along its tangent space: compare the turning moment
            ours, theirs = (x @ inputs[5].double().T for x in (ours, theirs))
            ours, theirs = ours - ours.T, theirs - theirs.T
        assert (ours - theirs).norm() < 2e-3 * theirs.norm() + 1e-5, name


def test_nothing_to_draw() -> None:
    out, grads = grads_of(scene(0, 0, 0.1), VIEW, True)
    assert out.alpha.abs().sum() == 0 and out.features.shape == (8, 29, 37)
    behind = scene(5, 0, 0.1)
    behind[0][:, 2] -= 100
    out, grads = grads_of(behind, VIEW, True)
    assert out.alpha.abs().sum() == 0 and all(x.abs().sum() == 0 for x in grads)


def test_the_chunk_of_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short chunks change rounding only; and two runs agree to the bit."""
    inputs = scene(30, 8, 0.1)
    view = Pinhole(20, 14, 30.0, 30.0, 10.0, 7.0)
    _, wide = grads_of(inputs, view, True)
    monkeypatch.setattr(kernels, "BACKWARD", SHIPPED)
    (_, one), (_, two) = (grads_of(inputs, view, True) for _ in range(2))
    assert SHIPPED["CHUNK"] < 32
    for a, b, c in zip(wide, one, two, strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(a.abs().max())) and torch.equal(b, c)


def test_projection_boxes_and_lists_are_those_of_numba() -> None:
    inputs = awkward(3)
    position, quaternion, log_scale, opacity, _, rotation, translation = inputs
    view = Pinhole(203, 117, 200.0, 190.0, 90.0, 66.0)
    geo, normal, box, visible = Project.apply(position, quaternion, log_scale, opacity, rotation, translation, view, False)
    geo2, normal2, box2, visible2 = project(position, quaternion, log_scale, opacity, rotation, translation, view, False)
    assert torch.equal(visible, visible2) and 40 < int(visible.sum()) < 120
    assert torch.allclose(normal, normal2, atol=1e-6)
    assert torch.allclose(geo[visible], geo2[visible], rtol=2e-3, atol=1e-4)
    assert float((box[visible] != box2[visible]).float().mean()) < 0.01  # a box that ends on a pixel centre may round either way
    depth = geo[:, 8].contiguous()
    ours, theirs = bin_surfels(depth, box, visible, 203, 117), bin_numba(depth.numpy(), box.numpy(), visible.numpy(), 203, 117)
    assert ours.starts.tolist() == theirs.starts.tolist() and ours.ids.tolist() == theirs.ids.tolist()
    assert sorted(ours.slots.tolist()) == list(range(len(ours.ids)))
    owner = torch.repeat_interleave(ours.front, ours.counts)
    assert torch.equal(owner[ours.slots], ours.ids.long())
