"""Emissive and bright reflecting patches on one gently curved wall under a known light."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.materials.emission import BOUNDARY_STEPS, Emission, find_emission
from gsbake.materials.linear_shading import PhotoSamples
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.split_sum import shade
from tests.support.linear import linear

SIDE, PHOTOS, ROUGH = 32, 8, 0.3
ROWS, COLUMNS = (x.ravel() for x in np.mgrid[:SIDE, :SIDE])
PLACE = np.column_stack([COLUMNS, ROWS, np.zeros(SIDE * SIDE)]).astype(np.float64)
#: The patch of the wall under test; the rest is a black dielectric.
PATCH = (np.abs(ROWS - SIDE / 2) < 8) & (np.abs(COLUMNS - SIDE / 2) < 8)
RADIANCE = np.array([0.01, 0.46, 0.85], np.float32)


def pairs() -> NDArray[np.int64]:
    grid = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    return np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:]))])


def detected(base: NDArray[np.float32], emission: NDArray[np.float32], curve: float = 0.5, noise: float = 0.0) -> Emission:
    """Detection on a wall of base colour `base` (n, 3) with `emission` (n, 3); the mesh's normals have noise of deviation `noise`."""
    rng = np.random.default_rng(0)
    turn = curve * (COLUMNS / SIDE - 0.5)
    true = np.stack([np.sin(turn), np.zeros_like(turn), np.cos(turn)], 1)
    normal = torch.as_tensor(true, dtype=torch.float32)
    meshed = torch.nn.functional.normalize(torch.as_tensor(true + noise * rng.normal(size=true.shape), dtype=torch.float32), dim=1)
    tables = EnvironmentLight.from_function(lambda d: np.tile(0.2 + 1.2 * np.clip(d @ [0.9, 0, 0.44], 0, None)[:, None], 3), 16).prefilter()
    own = np.full(len(base), ROUGH, np.float32)
    photos = []
    for _ in range(PHOTOS):
        towards = torch.nn.functional.normalize(torch.as_tensor(rng.normal(size=3) * 0.4 + [0, 0, 1], dtype=torch.float32), dim=0)
        view = towards.expand(len(base), 3)

        def shaded(
            colour: NDArray[np.float32], rough: NDArray[np.float32], metallic: float, at: torch.Tensor, view: torch.Tensor = view
        ) -> NDArray[np.float32]:
            with torch.no_grad():
                constant = torch.as_tensor(rough), torch.full((len(rough),), metallic)
                return np.asarray(shade(at, view, torch.as_tensor(colour), *constant, tables).numpy())

        def trial(value: float, rough: NDArray[np.float32], metallic: float, shaded=shaded) -> NDArray[np.float32]:  # type: ignore[no-untyped-def]
            return shaded(np.full((len(rough), 3), value, np.float32), rough, metallic, meshed)  # type: ignore[no-any-return]

        colour = shaded(base, own, 0.0, normal) + emission + rng.normal(scale=0.005, size=base.shape).astype(np.float32)
        clipped = np.clip(colour, 0, 1).astype(np.float32)
        photos.append(
            PhotoSamples(np.arange(len(base)), clipped, np.ones(len(base), np.float32), np.zeros(len(base), np.int32), linear(trial))
        )
    return find_emission(photos, own, pairs(), PLACE)


def wall(albedo: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Base colour, black with `albedo` (3,) in the patch, and no emission."""
    base = np.full((SIDE * SIDE, 3), 0.02, np.float32)
    base[PATCH] = albedo
    return base, np.zeros_like(base)


def test_emissive_region_is_detected_with_its_radiance() -> None:
    base, emission = wall(np.full(3, 0.02, np.float32))
    emission[PATCH] = RADIANCE
    found = detected(base, emission)
    assert found.regions == 1
    inside = PATCH[found.texel]
    assert inside.sum() == PATCH.sum()
    np.testing.assert_allclose(np.median(found.radiance[inside], 0), RADIANCE + 0.015, atol=0.02)
    rows, columns = ROWS[found.texel[~inside]], COLUMNS[found.texel[~inside]]
    assert (np.maximum(np.abs(rows - SIDE / 2), np.abs(columns - SIDE / 2)) <= 8 + BOUNDARY_STEPS).all()


def test_print_on_an_emissive_region_is_tolerated() -> None:
    base, emission = wall(np.full(3, 0.02, np.float32))
    emission[PATCH & ~((ROWS == 16) & (COLUMNS % 3 > 0))] = RADIANCE
    assert detected(base, emission).regions == 1


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("albedo", [(0.02, 0.46, 0.85), (0.9, 0.9, 0.9), (0.4, 0.4, 0.4)])
def test_reflecting_patch_is_not_emissive(albedo: tuple[float, float, float], noise: float) -> None:
    assert len(detected(*wall(np.array(albedo, np.float32)), noise=noise).texel) == 0


def test_flat_emitter_is_ambiguous() -> None:
    base, emission = wall(np.full(3, 0.02, np.float32))
    emission[PATCH] = RADIANCE
    assert len(detected(base, emission, curve=0.0).texel) == 0
