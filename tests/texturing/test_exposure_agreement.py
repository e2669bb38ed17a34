"""Exposures are distinguished from reflections by parts of the surface that face different ways."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.surfels.initialisation import fibonacci_sphere
from gsbake.texturing.exposure_agreement import DIRECTIONS, exposure_agreement
from gsbake.texturing.view_fusion import MIN_TEXELS

PHOTOS, POINTS = 30, 6000


def reflected(direction: np.ndarray, seed: int) -> np.ndarray:
    """Log radiance of a room with many lamps from `direction` (..., 3)."""
    rng = np.random.default_rng(seed)
    lamps = rng.normal(size=(40, 3))
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    return np.log(0.3 + np.exp(30 * (direction @ lamps.T - 1)).sum(-1))


def samples(sd: float, gloss: float, slope: float = 0.0, normal: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """Arguments of `exposure_agreement`: a sphere of random albedo seen from all around, exposures of standard deviation `sd` (of their
    logarithm), reflections of a room times `gloss`, photos from above brighter by `slope`."""
    rng = np.random.default_rng(5)
    position = fibonacci_sphere(POINTS)
    normal = position if normal is None else normal
    centres = 4 * fibonacci_sphere(PHOTOS)
    to_camera = centres - position[:, None]
    to_camera /= np.linalg.norm(to_camera, axis=2, keepdims=True)
    cosine = np.einsum("npd,nd->np", to_camera, normal)
    mirrored = 2 * cosine[..., None] * normal[:, None] - to_camera
    logs = rng.normal(-1, 0.3, (POINTS, 1)) + gloss * reflected(mirrored, 7) + sd * rng.normal(size=PHOTOS) + slope * centres[:, 2] / 4
    logs[cosine < 0.15] = np.nan
    return logs, np.tile(np.arange(PHOTOS), (POINTS, 1)), position, normal, centres


@pytest.mark.parametrize(("sd", "gloss"), [(0.1, 0.0), (0.35, 0.3)])
def test_exposures_are_common_to_all_parts(sd: float, gloss: float) -> None:
    agreement = exposure_agreement(*samples(sd, gloss))
    assert agreement is not None and agreement.share > 0.5 and agreement.pairs > 50


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_reflections_are_not_even_where_all_of_it_is_brighter_from_above(slope: float) -> None:
    agreement = exposure_agreement(*samples(0.0, 0.5, slope))
    assert agreement is not None and agreement.share < 0.1


def test_the_share_is_that_of_the_variances() -> None:
    """Independent gains of each cell of normals, of the same variance as the exposures: half is common."""
    logs, view, position, normal, centres = samples(0.3, 0.0)
    rng = np.random.default_rng(2)
    own = rng.normal(0, 0.3, (DIRECTIONS, PHOTOS))[(normal @ fibonacci_sphere(DIRECTIONS).T).argmax(1)]
    agreement = exposure_agreement(logs + own, view, position, normal, centres)
    assert agreement is not None and abs(agreement.share - 0.5) < 0.15 and 0.02 < agreement.error < 0.2


def test_a_sheet_has_no_parts_to_compare() -> None:
    """Both sides of a sheet are never seen together."""
    sheet = np.where(fibonacci_sphere(POINTS)[:, 2:] > 0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    assert exposure_agreement(*samples(0.35, 0.5, normal=sheet)) is None


def test_cells_of_few_points_say_nothing() -> None:
    """Too few to solve gains from: these are unknown, not equal."""
    logs, view, position, normal, centres = samples(0.35, 0.0)
    cell = (normal @ fibonacci_sphere(DIRECTIONS).T).argmax(1)
    few = np.zeros(POINTS, bool)
    for k in range(0, DIRECTIONS, 2):
        few[np.flatnonzero(cell == k)[: MIN_TEXELS - 1]] = True
    with_few, without = (
        exposure_agreement(logs[kept], view[kept], position[kept], normal[kept], centres) for kept in (few | (cell % 2 == 1), cell % 2 == 1)
    )
    assert with_few is not None and without is not None
    assert with_few.share == pytest.approx(without.share, abs=0.02) and with_few.pairs == without.pairs


def test_no_points_say_nothing() -> None:
    logs, view, position, normal, centres = samples(0.35, 0.0)
    assert exposure_agreement(logs[:0], view[:0], position[:0], normal[:0], centres) is None
