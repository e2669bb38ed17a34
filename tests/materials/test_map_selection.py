"""Maps that are not needed: left out on evidence, kept without."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.materials.map_selection import TOLERANCE, Floats, of_one_roughness, plainer, without_metal

VALUES = np.array([[0.5, 0.4, 0.2, 0.7, 0.1], [0.8, 0.8, 0.8, 0.3, 0.5], [0.2, 0.2, 0.2, 0.9, 0.0]], np.float32)
WEIGHT = np.array([3.0, 1.0, 1.0])


class Rules:
    """Decides as the evidence says, and remembers it."""

    def __init__(self) -> None:
        self.said: dict[str, tuple[bool, str]] = {}

    def __call__(self, rule: str, holds: bool, evidence: str, skipped: str, done: str) -> bool:
        self.said[rule] = holds, evidence
        return holds


def missing(metal: float, roughness: float) -> dict[tuple[bool, bool], float]:
    """dB that photos lose when metal, or roughness, is no longer mapped."""
    return {(True, True): 30.0, (False, True): 30.0 - metal, (True, False): 30.0 - roughness, (False, False): 30.0 - metal - roughness}


def judged(values: Floats, table: dict[tuple[bool, bool], float]) -> float:
    return table[bool(values[:, 4].any()), bool(np.ptp(values[:, 3]) > 0)]


@pytest.mark.parametrize(("metal", "roughness"), [(0.9, 0.9), (0.9, 1.1), (1.1, 0.9), (1.1, 1.1), (-5.0, -5.0)])
def test_a_map_goes_when_the_photos_do_not_miss_it(metal: float, roughness: float) -> None:
    rules, table = Rules(), missing(metal * TOLERANCE, roughness * TOLERANCE)
    out = plainer(VALUES, WEIGHT, 0, lambda values: judged(values, table), rules)
    assert rules.said["metallic_map"][0] == (not out[:, 4].any()) == (metal < 1)
    assert rules.said["roughness_map"][0] == (np.ptp(out[:, 3]) == 0) == (roughness < 1)


def test_metal_that_was_found_stays_and_no_photo_is_no_evidence() -> None:
    rules = Rules()
    assert (plainer(VALUES, WEIGHT, 2, lambda values: 30.0, rules)[:, 4] == VALUES[:, 4]).all()
    assert rules.said["metallic_map"][1].startswith("2 texels")
    assert plainer(VALUES, WEIGHT, 0, lambda values: None, rules) is VALUES
    assert rules.said["roughness_map"] == (False, "there are no photos to tell")


def test_without_metal_the_diffuse_reflectance_stays() -> None:
    out = without_metal(VALUES)
    assert np.allclose(out[:, :3], [[0.45, 0.36, 0.18], [0.4, 0.4, 0.4], [0.2, 0.2, 0.2]]) and not out[:, 4].any()
    assert (out[:, 3] == VALUES[:, 3]).all() and VALUES[0, 4] == np.float32(0.1)


def test_the_one_roughness_is_the_median_by_weight() -> None:
    assert (of_one_roughness(VALUES, WEIGHT)[:, 3] == np.float32(0.7)).all()
    assert (of_one_roughness(VALUES, np.array([1.0, 3.0, 1.0]))[:, 3] == np.float32(0.3)).all()
    assert len(of_one_roughness(VALUES[:0], WEIGHT[:0])) == 0
