"""Maps that are not needed are replaced by constants, on evidence."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.materials.levels import MapSelection, with_constant_roughness, without_metal
from gsbake.materials.surface import Materials

MAPS = Materials(
    np.array([[0.5, 0.4, 0.2], [0.8, 0.8, 0.8], [0.2, 0.2, 0.2]], np.float32), np.float32([0.7, 0.3, 0.9]), np.float32([0.1, 0.5, 0.0])
)
SELECTION = MapSelection()
WEIGHT = np.float32([3, 1, 1])


class Rules:
    """Decides by the measurement and records it."""

    def __init__(self) -> None:
        self.decisions: dict[str, tuple[bool, str]] = {}

    def __call__(self, rule: str, holds: bool, evidence: str, skipped: str, done: str) -> bool:
        self.decisions[rule] = holds, evidence
        return holds


def psnr_table(metal: float, roughness: float) -> dict[tuple[bool, bool], float]:
    """PSNR by whether metallic and roughness are mapped, with the losses `metal` and `roughness` in dB."""
    return {(True, True): 30.0, (False, True): 30.0 - metal, (True, False): 30.0 - roughness, (False, False): 30.0 - metal - roughness}


def psnr(maps: Materials, table: dict[tuple[bool, bool], float]) -> float:
    return table[bool(maps.metallic.any()), bool(np.ptp(maps.roughness) > 0)]


@pytest.mark.parametrize(("metal", "roughness"), [(0.9, 0.9), (0.9, 1.1), (1.1, 0.9), (1.1, 1.1), (-5.0, -5.0)])
def test_map_is_dropped_within_the_tolerance(metal: float, roughness: float) -> None:
    rules, table = Rules(), psnr_table(metal * SELECTION.psnr_loss, roughness * SELECTION.psnr_loss)
    out = SELECTION.selected(MAPS, WEIGHT, 0, lambda maps: psnr(maps, table), rules)
    assert rules.decisions["metallic_map"][0] == (not out.metallic.any()) == (metal < 1)
    assert rules.decisions["roughness_map"][0] == (np.ptp(out.roughness) == 0) == (roughness < 1)


def test_detected_metal_and_missing_photos_keep_the_maps() -> None:
    rules = Rules()
    assert (SELECTION.selected(MAPS, WEIGHT, 2, lambda maps: 30.0, rules).metallic == MAPS.metallic).all()
    assert rules.decisions["metallic_map"][1].startswith("2 metallic texels")
    assert SELECTION.selected(MAPS, WEIGHT, 0, lambda maps: None, rules) is MAPS
    assert rules.decisions["roughness_map"] == (False, "no photos to compare")


def test_without_metal_keeps_diffuse_reflectance() -> None:
    out = without_metal(MAPS)
    assert np.allclose(out.base_color, [[0.45, 0.36, 0.18], [0.4, 0.4, 0.4], [0.2, 0.2, 0.2]]) and not out.metallic.any()
    assert (out.roughness == MAPS.roughness).all() and MAPS.metallic[0] == np.float32(0.1)


def test_constant_roughness_is_the_weighted_median() -> None:
    assert (with_constant_roughness(MAPS, WEIGHT).roughness == np.float32(0.7)).all()
    assert (with_constant_roughness(MAPS, np.float32([1, 3, 1])).roughness == np.float32(0.3)).all()
    assert len(with_constant_roughness(MAPS.of(np.zeros(0, np.int64)), WEIGHT[:0])) == 0
