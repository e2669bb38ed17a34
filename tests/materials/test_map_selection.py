"""Maps that are not needed are replaced by constants, on evidence."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.materials.map_selection import MAX_PSNR_LOSS, Floats, drop_unneeded_maps, with_constant_roughness, without_metal

VALUES = np.array([[0.5, 0.4, 0.2, 0.7, 0.1], [0.8, 0.8, 0.8, 0.3, 0.5], [0.2, 0.2, 0.2, 0.9, 0.0]], np.float32)
WEIGHT = np.array([3.0, 1.0, 1.0])


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


def psnr(values: Floats, table: dict[tuple[bool, bool], float]) -> float:
    return table[bool(values[:, 4].any()), bool(np.ptp(values[:, 3]) > 0)]


@pytest.mark.parametrize(("metal", "roughness"), [(0.9, 0.9), (0.9, 1.1), (1.1, 0.9), (1.1, 1.1), (-5.0, -5.0)])
def test_map_is_dropped_within_the_tolerance(metal: float, roughness: float) -> None:
    rules, table = Rules(), psnr_table(metal * MAX_PSNR_LOSS, roughness * MAX_PSNR_LOSS)
    out = drop_unneeded_maps(VALUES, WEIGHT, 0, lambda values: psnr(values, table), rules)
    assert rules.decisions["metallic_map"][0] == (not out[:, 4].any()) == (metal < 1)
    assert rules.decisions["roughness_map"][0] == (np.ptp(out[:, 3]) == 0) == (roughness < 1)


def test_detected_metal_and_missing_photos_keep_the_maps() -> None:
    rules = Rules()
    assert (drop_unneeded_maps(VALUES, WEIGHT, 2, lambda values: 30.0, rules)[:, 4] == VALUES[:, 4]).all()
    assert rules.decisions["metallic_map"][1].startswith("2 metallic texels")
    assert drop_unneeded_maps(VALUES, WEIGHT, 0, lambda values: None, rules) is VALUES
    assert rules.decisions["roughness_map"] == (False, "no photos to compare")


def test_without_metal_keeps_diffuse_reflectance() -> None:
    out = without_metal(VALUES)
    assert np.allclose(out[:, :3], [[0.45, 0.36, 0.18], [0.4, 0.4, 0.4], [0.2, 0.2, 0.2]]) and not out[:, 4].any()
    assert (out[:, 3] == VALUES[:, 3]).all() and VALUES[0, 4] == np.float32(0.1)


def test_constant_roughness_is_the_weighted_median() -> None:
    assert (with_constant_roughness(VALUES, WEIGHT)[:, 3] == np.float32(0.7)).all()
    assert (with_constant_roughness(VALUES, np.array([1.0, 3.0, 1.0]))[:, 3] == np.float32(0.3)).all()
    assert len(with_constant_roughness(VALUES[:0], WEIGHT[:0])) == 0
