"""Shading against the full rendering equation, the white furnace, numerical gradients and its own twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsbake.geometry.vectors import unit
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import LightTables
from gsbake.shading.split_sum import _reference, shade
from tests.support.directional_albedo import MEAN_DIELECTRIC, between_microfacets, fresnel_of_dielectric


def buffers(count: int, seed: int, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    """Normal, view, albedo, roughness, metallic of random visible pixels."""
    g = torch.Generator().manual_seed(seed)
    unit = torch.nn.functional.normalize
    view = unit(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1)
    normal = unit(view + 0.8 * unit(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1), dim=1)
    albedo = torch.rand(count, 3, generator=g, dtype=torch.float64)
    rough = 0.09 + 0.9 * torch.rand(count, generator=g, dtype=torch.float64)
    metal = torch.rand(count, generator=g, dtype=torch.float64)
    return [t.to(dtype) for t in (normal, view, albedo, rough, metal)]


def noise_light(size: int, seed: int = 0) -> LightTables:
    return EnvironmentLight.from_radiance(np.random.default_rng(seed).random((6, size, size, 3)) + 0.1).prefilter().detach()


def window(dirs: np.ndarray) -> np.ndarray:
    bright = np.exp(8.0 * (dirs @ unit(np.array([0.4, 0.5, 0.77])) - 1.0))
    return (0.2 + 0.1 * dirs[:, 1:2]) * np.ones(3) + 3.0 * bright[:, None] * np.array([1.0, 0.9, 0.7])


def test_white_furnace() -> None:
    tables = EnvironmentLight(8, 1.0).prefilter()
    normal, view, albedo, rough, _ = buffers(500, 1)
    zero, one = torch.zeros(500), torch.ones(500)
    lit = shade(normal, view, albedo, one, zero, tables)
    assert (lit >= albedo - 1e-4).all() and (lit <= albedo + 0.05 + 0.3 * (1 - (normal * view).sum(1, keepdim=True)).clamp_min(0)).all()
    mirror = shade(normal, view, torch.ones(500, 3), rough, one, tables)
    assert (mirror <= 1.0001).all()  # F0 = 1 returns A + B ≤ 1 …
    smooth = shade(normal, view, torch.ones(500, 3), torch.full((500,), 0.08), one, tables)
    assert (smooth > 0.97).all()  # … and nearly all of it when smooth
    black = shade(normal, view, torch.zeros(500, 3), rough, one, tables)
    assert (black >= 0).all() and (black <= shade(normal, view, albedo, rough, one, tables) + 1e-6).all()


@pytest.mark.slow
def test_sphere_against_the_rendering_equation() -> None:
    """Monte Carlo of the whole BRDF (attenuated Lambert + GGX, Smith, Fresnel, light between microfacets), cosine-sampled, on the analytic
    light."""
    tables = EnvironmentLight.from_function(window, 32).prefilter()
    rng = np.random.default_rng(3)
    xy = rng.uniform(-0.85, 0.85, (400, 2))
    xy = xy[(xy**2).sum(axis=1) < 0.72][:120]
    normal = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=1, keepdims=True))], axis=1)
    view = np.broadcast_to([0.0, 0.0, 1.0], normal.shape)
    count = 20_000
    u, phi = (np.arange(count) + rng.random(count)) / count, 2 * math.pi * ((np.arange(count) * 0.6180339887) % 1)
    local = np.stack([np.sqrt(u) * np.cos(phi), np.sqrt(u) * np.sin(phi), np.sqrt(1 - u)], axis=1)
    dielectrics, metals = ((0.5, 0.0, 0.02), (0.8, 0.0, 0.02), (0.9, 0.0, 0.02)), ((0.4, 1.0, 0.1), (0.6, 1.0, 0.1), (0.9, 0.5, 0.1))
    for roughness, metallic, tolerance in dielectrics + metals:
        albedo, alpha = np.array([0.6, 0.35, 0.2]), roughness**2
        truth = np.empty_like(normal)
        for i, n in enumerate(normal):
            side = unit(np.cross(n, [0.9, -0.1, 0.3]))
            light = local @ np.stack([side, np.cross(n, side), n])
            h = unit(light + view[i])
            nl, nv, nh, vh = local[:, 2], n @ view[i], h @ n, h @ view[i]
            density = alpha**2 / (math.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
            visibility = 0.5 / (nl * math.sqrt(nv**2 * (1 - alpha**2) + alpha**2) + nv * np.sqrt(nl**2 * (1 - alpha**2) + alpha**2))
            dielectric = fresnel_of_dielectric(vh) * between_microfacets(round(nv, 2), roughness, MEAN_DIELECTRIC)
            again = [between_microfacets(round(nv, 2), roughness, f0 + (1 - f0) / 21) for f0 in albedo]
            conductor = (albedo + (1 - albedo) * (1 - vh[:, None]) ** 5) * again
            lobe = density * visibility
            transmitted = 1 - math.pi * (dielectric * lobe).mean()  # what the specular layer lets through
            specular = metallic * conductor + (1 - metallic) * dielectric[:, None]
            brdf = transmitted * (1 - metallic) * albedo / math.pi + specular * lobe[:, None]
            truth[i] = math.pi * (brdf * window(light)).mean(axis=0)
        flat = torch.ones(len(normal))
        got = shade(
            torch.from_numpy(normal).float(),
            torch.from_numpy(view.copy()).float(),
            torch.from_numpy(albedo).float().expand(len(normal), 3),
            roughness * flat,
            metallic * flat,
            tables,
        )
        error = got.detach().numpy() - truth
        assert np.sqrt((error**2).mean() / (truth**2).mean()) < tolerance
        assert abs(error.mean() / truth.mean()) < tolerance


def test_gradcheck_in_double() -> None:
    light = EnvironmentLight.from_radiance(np.random.default_rng(5).random((6, 4, 4, 3)) + 0.1).double()
    inputs = [t.requires_grad_(True) for t in buffers(6, 6, torch.float64)]
    occlusion = torch.linspace(0.3, 1.0, 6, dtype=torch.float64, requires_grad=True)

    def full(raw: torch.Tensor, *rest: torch.Tensor) -> torch.Tensor:
        tables = torch.func.functional_call(_Prefilter(light), {"light.raw": raw})
        return shade(*rest, tables)  # type: ignore[arg-type, call-arg]

    assert torch.autograd.gradcheck(full, (light.raw, *inputs), fast_mode=True)
    tables = light.prefilter().detach()
    assert torch.autograd.gradcheck(lambda *rest: shade(*rest, tables), inputs)  # type: ignore[call-arg]
    # Occlusion darkens the lobe as a function of normal and roughness whose gradient is left out on purpose: check it alone.
    fixed = [t.detach() for t in inputs]
    assert torch.autograd.gradcheck(lambda o: shade(*fixed, tables, o), (occlusion,))  # type: ignore[call-arg, arg-type]


class _Prefilter(torch.nn.Module):
    def __init__(self, light: EnvironmentLight) -> None:
        super().__init__()
        self.light = light

    def forward(self) -> LightTables:
        return self.light.prefilter()


@pytest.mark.parametrize("size", [8, 32])
def test_kernel_equals_twin(size: int) -> None:
    """Forward and every gradient, also of pixels that turn away, with zero-length normals and roughness off the ends."""
    count = 3000
    normal, view, albedo, rough, metal = buffers(count, 7)
    normal[:300] *= -1.0
    normal[300:320] = 0.0
    normal[320:400] *= 0.3
    rough[400:450], rough[450:500], albedo[500:600], metal[600:650] = 0.0, 1.0, 0.0, 1.0
    normal[700:750] = view[700:750]
    g = torch.Generator().manual_seed(8)
    weight = torch.randn(count, 3, generator=g)
    open_d, open_s = torch.rand(count, generator=g), torch.rand(count, generator=g)
    tables = noise_light(size)
    results = []
    for kernel in (True, False):
        dtype = torch.float32 if kernel else torch.float64
        leaves = [t.to(dtype, copy=True).requires_grad_(True) for t in (normal, view, albedo, rough, metal, open_d, open_s, tables.table)]
        light = LightTables(leaves[-1], tables.layout)
        if kernel:
            from gsbake.shading.split_sum import _Kernel

            out = _Kernel.apply(light.layout, *leaves)
        else:
            out = _reference(*leaves[:-1], light)  # type: ignore[call-arg, arg-type]
        (out * weight.to(dtype)).sum().backward()
        results.append([out.detach().double(), *(torch.zeros_like(t) if t.grad is None else t.grad.double() for t in leaves)])
    names = ("colour", "normal", "view", "albedo", "roughness", "metallic", "open_d", "open_s", "table")
    for name, fast, slow in zip(names, *results, strict=True):
        assert torch.isfinite(fast).all(), name
        close = (fast - slow).abs() <= 2e-4 + 2e-3 * slow.abs()
        # Float32 may put a pixel in the neighbouring texel, where bilinear slopes differ: a handful, not more.
        assert close.double().mean() > 0.998, name
        assert (fast - slow).norm() / slow.norm() < 0.02, name


def test_float32_uses_the_kernel_and_agrees_through_the_public_door() -> None:
    inputs = buffers(200, 9)
    tables = noise_light(8)
    occlusion = torch.rand(200, generator=torch.Generator().manual_seed(1))
    for extra in ((), (occlusion,)):
        normal, view, albedo, rough, metal = inputs
        fast = shade(normal, view, albedo, rough, metal, tables, *extra)
        normal, view, albedo, rough, metal = (t.double() for t in inputs)
        wide = LightTables(tables.table.double(), tables.layout)
        slow = shade(normal, view, albedo, rough, metal, wide, *[t.double() for t in extra])
        torch.testing.assert_close(fast, slow.float(), rtol=1e-3, atol=1e-4)


def test_degenerate_inputs_have_finite_gradients() -> None:
    rows = [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.0, 0.0),
        ([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 0.0, 1.0),
        ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.5, 0.5),
        ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], 1.0, 0.0),
        ([0.0, 1.0, 1e-8], [0.0, -1.0, 1e-8], 0.08, 1.0),
    ]
    for dtype in (torch.float32, torch.float64):
        normal = torch.tensor([r[0] for r in rows], dtype=dtype, requires_grad=True)
        view = torch.tensor([r[1] for r in rows], dtype=dtype, requires_grad=True)
        rough = torch.tensor([r[2] for r in rows], dtype=dtype, requires_grad=True)
        metal = torch.tensor([r[3] for r in rows], dtype=dtype, requires_grad=True)
        albedo = torch.zeros(len(rows), 3, dtype=dtype, requires_grad=True)
        occlusion = torch.zeros(len(rows), dtype=dtype, requires_grad=True)
        light = EnvironmentLight(8).to(dtype)
        for extra in ((), (occlusion,)):
            out = shade(normal, view, albedo, rough, metal, light.prefilter(), *extra)
            out.sum().backward()
            assert torch.isfinite(out).all()
        for leaf in (normal, view, rough, metal, albedo, occlusion, light.raw):
            assert leaf.grad is not None and torch.isfinite(leaf.grad).all()
            assert leaf.grad.abs().max() < 1e4


def test_not_a_number_stays_in_its_pixel() -> None:
    normal, view, albedo, rough, metal = buffers(10, 12)
    normal[3] = math.nan
    rough[4] = math.nan
    out = shade(normal, view, albedo, rough, metal, noise_light(8))
    assert torch.isfinite(out[[0, 1, 2, 5, 6, 7, 8, 9]]).all()


def test_light_is_recovered_from_a_shaded_sphere() -> None:
    """Gradient descent on the light alone finds the light that shaded a known glossy sphere."""
    truth = EnvironmentLight.from_function(window, 8).prefilter().detach()
    g = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(2000, 3, generator=g), dim=1)
    view = torch.nn.functional.normalize(normal + 0.5 * torch.randn(2000, 3, generator=g), dim=1)
    albedo, rough, metal = torch.full((2000, 3), 0.7), torch.full((2000,), 0.15), torch.full((2000,), 0.5)
    target = shade(normal, view, albedo, rough, metal, truth)
    light = EnvironmentLight(8)
    optimiser = torch.optim.Adam(light.parameters(), lr=0.05)
    first = last = 0.0
    for step in range(150):
        optimiser.zero_grad()
        loss = (shade(normal, view, albedo, rough, metal, light.prefilter()) - target).abs().mean()
        loss.backward()
        optimiser.step()
        first, last = (loss.item() if step == 0 else first), loss.item()
    assert last < 0.05 * first
