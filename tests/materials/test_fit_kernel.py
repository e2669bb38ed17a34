"""The kernels of the material fit against their PyTorch reference, forward and backward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import set_num_threads

from gsbake.imaging.srgb import encode
from gsbake.materials import adam_kernel, fit_kernel
from gsbake.materials.linear_shading import KernelTables, PhotoLights, ShadingStep, linear_samples
from gsbake.materials.photo import Photo
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import LightTables
from tests.materials.reference import Batch, Transport, photo_loss, prior_loss

TEXELS, PIXELS = 300, 2000
RESIDUAL_WEIGHT, ROBUST = 1.5, 0.1


class Case:
    """Random texels, pixels and light."""

    def __init__(self, seed: int, traced: bool) -> None:
        rng = np.random.default_rng(seed)
        unit = rng.normal(size=(TEXELS, 3))
        self.normal = (unit / np.linalg.norm(unit, axis=1, keepdims=True)).astype(np.float32)
        self.values = np.concatenate([rng.uniform(0.02, 0.98, (TEXELS, 5)), rng.normal(0, 0.1, (TEXELS, 3))], 1).astype(np.float32)
        self.transport = np.zeros(TEXELS, fit_kernel.TRANSPORT)
        for name in fit_kernel.TRANSPORT.names or ():
            high = 0.2 if name in ("indirect", "emission", "diffuse", "metal_colour") else 1
            self.transport[name] = rng.uniform(0, high, self.transport[name].shape)
        self.transport["normal"] = self.normal[rng.permutation(TEXELS)]
        texel = rng.integers(0, TEXELS, (PIXELS, 4)).astype(np.int32)
        bilinear = rng.dirichlet(np.ones(4), PIXELS).astype(np.float32)
        bilinear[:50] = [1, 0, 0, 0]
        view = self.normal[texel[:, 0]] + rng.normal(0, 0.8, (PIXELS, 3))
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        reflected = np.where(rng.uniform(size=PIXELS) < 0.3, rng.integers(0, TEXELS, PIXELS), -1) if traced else np.zeros(0)
        self.photo = Photo(
            texel, bilinear, np.zeros((PIXELS, 3), np.float32), view.astype(np.float32), rng.uniform(0, 1, (PIXELS, 3)).astype(np.float32),
            rng.uniform(0, 1, PIXELS).astype(np.float32), np.zeros(PIXELS, np.int32), np.arange(PIXELS), reflected.astype(np.int32),
        ).with_normals(self.normal)  # fmt: skip
        radiance = rng.uniform(0, 1, (6, 8, 8, 3)) ** 3
        self.light = EnvironmentLight.from_radiance(radiance.astype(np.float32))
        self.tables = self.light.prefilter().detach()


def reference(case: Case) -> tuple[float, np.ndarray, np.ndarray]:
    """Loss and its gradients for the texels (TEXELS, 8) and the light's table."""
    values = torch.tensor(case.values[:, :5], requires_grad=True)
    offset = torch.tensor(case.values[:, 5:], requires_grad=True)
    table = case.tables.table.clone().requires_grad_()
    batch = Batch.of(case.photo)
    tables = LightTables(table, case.tables.layout)
    loss = photo_loss(batch, values, offset, tables, Transport.of(case.transport), RESIDUAL_WEIGHT, ROBUST)
    loss.backward()
    assert values.grad is not None and offset.grad is not None and table.grad is not None
    return float(loss.detach()), torch.cat([values.grad, offset.grad], 1).numpy(), table.grad.numpy()


@pytest.mark.parametrize("traced", [False, True])
def test_loss_and_gradients(traced: bool) -> None:
    case = Case(1, traced)
    loss, texel_gradient, table_gradient = reference(case)
    step, batch = ShadingStep(TEXELS), case.photo
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
    occlusion = case.transport["visibility"] * 0.85  # at least so much is blocked that indirect light tells what blocks it
    transport["visibility"] = transport["occlusion"] = occlusion
    transport["indirect"], transport["normal"] = level * (1 - occlusion[:, None]), case.normal
    transport["diffuse"] = level  # radiosity / π of a white object, whose specular layer reflects the same
    values = torch.tensor(case.values[:, :5])
    batch = Batch.of(case.photo)
    shaded = batch.shade(values, torch.zeros(TEXELS, 3), tables, Transport.of(transport))
    clear = np.zeros_like(transport)
    clear["visibility"] = clear["occlusion"] = 1
    alone = Batch.of(replace(case.photo, reflected=np.zeros(0, np.int32)))
    torch.testing.assert_close(shaded, alone.shade(values, torch.zeros(TEXELS, 3), tables, Transport.of(clear)), rtol=2e-3, atol=1e-3)


def test_results_do_not_depend_on_threads() -> None:
    case = Case(2, True)
    found = []
    for threads in (1, 2):
        set_num_threads(threads)
        step, tables = ShadingStep(TEXELS), KernelTables.of(case.tables)
        sums = step(case.photo, case.values, tables, case.transport, RESIDUAL_WEIGHT, ROBUST, 1 / PIXELS)
        found.append((sums, step.gradient.copy(), step.table.copy()))
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)


def test_linear_shading_is_the_shading_at_both_ends() -> None:
    case = Case(3, True)
    photo = replace(case.photo, bilinear=np.tile(np.array([1, 0, 0, 0], np.float32), (PIXELS, 1))).with_normals(case.normal)
    (samples,) = linear_samples([photo], case.values[:, 5:], case.transport, PhotoLights(case.light.radiance().detach()))
    torch_batch = Batch.of(photo)
    rough = np.ascontiguousarray(case.values[:, 3])
    for metallic in (0.0, 1.0):
        shading = samples.shade(rough).of(metallic > 0)
        values = case.values[:, :5].copy()
        values[:, 4] = metallic
        inputs = torch.as_tensor(values), torch.as_tensor(case.values[:, 5:])
        expected = torch_batch.shade(*inputs, case.tables, Transport.of(case.transport))
        base = case.values[photo.dominant_texel, :3]
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
        adam_kernel.adam_step(
            raw, values, spare, gradient, first, second, start, neighbour, smoothness, mean, f(offset_weight), common, common_weight, rate,
            f(0.9), f(0.99), f(1 / (1 - 0.9**k)), f(1 / (1 - 0.99**k)), f(2e-3),
        )  # fmt: skip
        values, spare = spare, values
        assert not gradient.any()
    np.testing.assert_allclose(values[:, :5], torch.sigmoid(logits).detach().numpy(), atol=2e-4)
    np.testing.assert_allclose(values[:, 5:], offset.detach().numpy(), atol=2e-4)

    kept = [array[:, 5:].copy() for array in (raw, values, first, second)]
    gradient, rate[5:] = data.copy(), 0
    adam_kernel.adam_step(
        raw, values, spare, gradient, first, second, start, neighbour, smoothness, mean, f(offset_weight), common, common_weight, rate,
        f(0.9), f(0.99), f(1), f(1), f(2e-3),
    )  # fmt: skip
    assert not gradient.any() and not np.array_equal(spare[:, :5], values[:, :5])
    for before, after in zip(kept, (raw, spare, first, second), strict=True):
        np.testing.assert_array_equal(after[:, 5:], before)


def test_the_curve_and_its_slope_are_those_of_srgb() -> None:
    linear = np.append(np.geomspace(1e-5, 0.999, 500), [0.0, 1.0, 2.0, np.nan]).astype(np.float32)
    found = np.array([fit_kernel.srgb_and_slope(value) for value in linear])
    np.testing.assert_allclose(found[:502, 0], encode(linear[:502]), atol=4e-6)
    assert found[502, 0] == pytest.approx(1) and np.isnan(found[503, 0])  # neither reads beyond the table
    inner = linear[:500].astype(np.float64)
    slope = np.where(inner <= 0.0031308, 12.92, 1.055 / 2.4 * inner ** (1 / 2.4 - 1))
    bright = inner > 1e-4  # below, lines are as wide as the curve is steep
    np.testing.assert_allclose(found[:500, 1][bright], slope[bright], rtol=6e-2)
    assert np.abs(found[:500, 1] / slope - 1)[bright].mean() < 6e-3


def test_the_logistic_function_of_the_steps() -> None:
    x = np.linspace(-12, 12, 101, dtype=np.float32)
    np.testing.assert_allclose([adam_kernel._logistic(value) for value in x], 1 / (1 + np.exp(-x.astype(np.float64))), atol=1e-6)
    assert 0 < adam_kernel._logistic(np.float32(-99)) < 1e-6


def test_photos_under_one_light_are_shaded_together() -> None:
    """What two photos show apart they show together; another light is apart, and blocks of different photos have different numbers."""
    case = Case(6, True)
    turned = replace(case.photo, to_light=np.eye(3)[[1, 2, 0]])
    lights = PhotoLights(case.light.radiance().detach())
    parts = [case.photo.rows(slice(0, 1200)), case.photo.rows(slice(1200, None)), turned]
    together, alone = linear_samples(parts, case.values[:, 5:], case.transport, lights)
    assert together.start == (1200,) and alone.start == () and len(alone.texel) == PIXELS
    assert not set(together.block[:1200]) & set(together.block[1200:])
    rough = np.ascontiguousarray(case.values[:, 3])
    apart = [linear_samples([part], case.values[:, 5:], case.transport, lights)[0].shade(rough).metal.offset for part in parts]
    np.testing.assert_array_equal(together.shade(rough).metal.offset, np.concatenate(apart[:2]))
    np.testing.assert_array_equal(alone.shade(rough).metal.offset, apart[2])
