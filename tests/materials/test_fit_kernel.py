"""The kernels of the material fit against their PyTorch reference, forward and backward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import set_num_threads

from gsbake.materials import fit_kernel
from gsbake.materials.fit_reference import Batch, photo_loss, prior_loss
from gsbake.materials.photo_batch import FitStep, KernelTables, PhotoBatch, TexelInputs
from gsbake.materials.pixels import Pixels
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import LightTables

TEXELS, PIXELS = 300, 2000
RESIDUAL_WEIGHT, ROBUST = 1.5, 0.1


class Case:
    """Random texels, pixels and light."""

    def __init__(self, seed: int, traced: bool) -> None:
        rng = np.random.default_rng(seed)
        unit = rng.normal(size=(TEXELS, 3))
        self.normal = (unit / np.linalg.norm(unit, axis=1, keepdims=True)).astype(np.float32)
        self.values = np.concatenate([rng.uniform(0.02, 0.98, (TEXELS, 5)), rng.normal(0, 0.1, (TEXELS, 3))], 1).astype(np.float32)
        self.transport = rng.uniform(0, 1, (TEXELS, fit_kernel.TRANSPORT)).astype(np.float32)
        self.transport[:, 2:14] *= 0.2
        self.transport[:, 15:18] = self.normal[rng.permutation(TEXELS)]
        texel = rng.integers(0, TEXELS, (PIXELS, 4))
        bilinear = rng.dirichlet(np.ones(4), PIXELS).astype(np.float32)
        bilinear[:50] = [1, 0, 0, 0]
        view = self.normal[texel[:, 0]] + rng.normal(0, 0.8, (PIXELS, 3))
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        reflected = np.where(rng.uniform(size=PIXELS) < 0.3, rng.integers(0, TEXELS, PIXELS), -1) if traced else None
        self.pixels = Pixels(
            texel, bilinear, view.astype(np.float32), rng.uniform(0, 1, (PIXELS, 3)).astype(np.float32),
            rng.uniform(0, 1, PIXELS).astype(np.float32), np.zeros(PIXELS, np.int32), np.arange(PIXELS), reflected,
        )  # fmt: skip
        radiance = rng.uniform(0, 1, (6, 8, 8, 3)) ** 3
        self.tables = EnvironmentLight.from_radiance(radiance.astype(np.float32)).prefilter().detach()


def reference(case: Case) -> tuple[float, np.ndarray, np.ndarray]:
    """Loss and its gradients for the texels (TEXELS, 8) and the light's table."""
    values = torch.tensor(case.values[:, :5], requires_grad=True)
    offset = torch.tensor(case.values[:, 5:], requires_grad=True)
    table = case.tables.table.clone().requires_grad_()
    batch = Batch.of(case.pixels, torch.as_tensor(case.normal))
    tables = LightTables(table, case.tables.layout)
    loss = photo_loss(batch, values, offset, tables, torch.as_tensor(case.transport), RESIDUAL_WEIGHT, ROBUST)
    loss.backward()
    assert values.grad is not None and offset.grad is not None and table.grad is not None
    return float(loss.detach()), torch.cat([values.grad, offset.grad], 1).numpy(), table.grad.numpy()


@pytest.mark.parametrize("traced", [False, True])
def test_loss_and_gradients(traced: bool) -> None:
    case = Case(1, traced)
    loss, texel_gradient, table_gradient = reference(case)
    step, batch = FitStep(TEXELS), PhotoBatch.of(case.pixels, case.normal)
    tables = KernelTables.of(case.tables)
    sums = step(batch, case.values, tables, case.transport, RESIDUAL_WEIGHT, ROBUST, 1 / PIXELS)
    assert sums[0] / PIXELS == pytest.approx(loss, rel=1e-4)
    for found, expected in ((step.gradient, texel_gradient), (step.table.sum(0), table_gradient)):
        # A pixel on a kink of the interpolation (a texel's edge) may fall on either side.
        error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        assert error < 2e-3


@pytest.mark.parametrize("traced", [False, True])
def test_object_as_bright_as_the_room_changes_nothing(traced: bool) -> None:
    """Under an even light L, whatever blocks it sends L as well: every material shows what it would show in the open."""
    case, level = Case(5, traced), 0.7
    tables = EnvironmentLight.from_radiance(np.full((6, 8, 8, 3), level, np.float32)).prefilter().detach()
    transport = np.zeros_like(case.transport)
    occlusion = case.transport[:, :1] * 0.85  # at least so much is blocked that indirect light tells what blocks it
    transport[:, :2], transport[:, 2:5], transport[:, 15:18] = occlusion, level * (1 - occlusion), case.normal
    transport[:, 8:11] = level  # diffuse radiosity / π of a white object, whose specular layer reflects the same
    values = torch.tensor(case.values[:, :5])
    batch = Batch.of(case.pixels, torch.as_tensor(case.normal))
    shaded = batch.shade(values, torch.zeros(TEXELS, 3), tables, torch.as_tensor(transport))
    clear = np.zeros_like(transport)
    clear[:, :2] = 1
    alone = Batch.of(replace(case.pixels, reflected_texel=None), torch.as_tensor(case.normal))
    torch.testing.assert_close(shaded, alone.shade(values, torch.zeros(TEXELS, 3), tables, torch.as_tensor(clear)), rtol=2e-3, atol=1e-3)


def test_results_do_not_depend_on_threads() -> None:
    case = Case(2, True)
    found = []
    for threads in (1, 2):
        set_num_threads(threads)
        step = FitStep(TEXELS)
        batch, tables = PhotoBatch.of(case.pixels, case.normal), KernelTables.of(case.tables)
        sums = step(batch, case.values, tables, case.transport, RESIDUAL_WEIGHT, ROBUST, 1 / PIXELS)
        found.append((sums, step.gradient.copy(), step.table.copy()))
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)


def test_linear_shading_is_the_shading_at_both_ends() -> None:
    case = Case(3, True)
    batch = PhotoBatch.of(replace(case.pixels, bilinear=np.tile(np.array([1, 0, 0, 0], np.float32), (PIXELS, 1))), case.normal)
    tables = KernelTables.of(case.tables)
    samples = batch.samples(TexelInputs.of(case.values, case.transport), tables)
    torch_batch = Batch.of(replace(case.pixels, bilinear=batch.bilinear), torch.as_tensor(case.normal))
    rough = np.ascontiguousarray(case.values[:, 3])
    for metallic in (0.0, 1.0):
        shading = samples.shade(rough, metallic)
        values = case.values[:, :5].copy()
        values[:, 4] = metallic
        inputs = torch.as_tensor(values), torch.as_tensor(case.values[:, 5:])
        expected = torch_batch.shade(*inputs, case.tables, torch.as_tensor(case.transport))
        base = case.values[batch.dominant_texel, :3]
        np.testing.assert_allclose(base * shading.slope + shading.offset, expected.numpy(), rtol=2e-3, atol=2e-4)


def test_adam_step_follows_pytorch() -> None:
    """Three steps with all priors against torch.optim.Adam."""
    rng = np.random.default_rng(0)
    case = Case(4, False)
    pairs = rng.integers(0, TEXELS, (900, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    data = rng.normal(0, 0.5, (TEXELS, 8)).astype(np.float32)
    smoothness, mean = rng.uniform(0, 0.1, 8).astype(np.float32), np.append(rng.uniform(0, 0.1, 5), [0] * 3).astype(np.float32)
    common, common_weight = rng.uniform(0, 1, (TEXELS, 4)).astype(np.float32), rng.uniform(0, 1, 4).astype(np.float32)
    rate, offset_weight = np.array([0.15] * 5 + [0.01] * 3, np.float32), 0.1

    logits = torch.logit(torch.tensor(case.values[:, :5])).requires_grad_()
    offset = torch.tensor(case.values[:, 5:], requires_grad=True)
    optimiser = torch.optim.Adam([{"params": logits, "lr": 0.15}, {"params": offset, "lr": 0.01}], betas=(0.9, 0.99), eps=2e-3)

    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    start, neighbour = np.searchsorted(both[:, 0], np.arange(TEXELS + 1)), both[:, 1].astype(np.int32)
    raw = np.concatenate([logits.detach().numpy(), case.values[:, 5:]], 1).copy()
    values, spare = case.values.copy(), np.empty_like(case.values)
    first, second = np.zeros_like(raw), np.zeros_like(raw)
    for k in range(1, 4):
        optimiser.zero_grad()
        materials = torch.sigmoid(logits)
        loss = prior_loss(
            materials, offset, torch.as_tensor(pairs), torch.as_tensor(smoothness), torch.as_tensor(mean[:5]), offset_weight,
            torch.as_tensor(common), torch.as_tensor(common_weight),
        )  # fmt: skip
        (loss + (torch.cat([materials, offset], 1) * torch.as_tensor(data)).sum()).backward()
        optimiser.step()
        gradient, f = data.copy(), np.float32
        fit_kernel.adam_step(
            raw, values, spare, gradient, first, second, start, neighbour, smoothness, mean, f(offset_weight), common, common_weight, rate,
            f(0.9), f(0.99), f(1 / (1 - 0.9**k)), f(1 / (1 - 0.99**k)), f(2e-3),
        )  # fmt: skip
        values, spare = spare, values
        assert not gradient.any()
    np.testing.assert_allclose(values[:, :5], torch.sigmoid(logits).detach().numpy(), atol=2e-4)
    np.testing.assert_allclose(values[:, 5:], offset.detach().numpy(), atol=2e-4)
