"""The rules for growing and pruning: what each chooses of a few surfels whose right answer was worked out by hand."""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

import pytest
import torch
from torch import Tensor

from gsbake.config.schema import Refine, Section, Train
from gsbake.surfels.densification.policies import GROWING, PRUNING, Placement, growth

#: Spacing .01: on the surface, one, two, four and fifty spacings off it.
DISTANCE = torch.tensor([0.0, 0.01, 0.02, 0.04, 0.5])
GRADIENT = torch.tensor([1.0, 2.0, 4.0, 8.0, 5.0])


def at(distance: Tensor = DISTANCE, opacity: float = 1.0) -> Placement:
    return Placement(distance, torch.full_like(distance, opacity), 0.01, 0.03)


def order(name: str, placement: Placement) -> list[int]:
    """Surfels that multiply, the first to do so first."""
    score = GROWING[name](GRADIENT, placement)
    return [i for i in torch.argsort(score, descending=True, stable=True).tolist() if score[i] > 0]


def dropped(name: str, placement: Placement) -> list[int]:
    return PRUNING[name](placement).nonzero()[:, 0].tolist()


def test_the_gradient_alone() -> None:
    assert order("gradient", at()) == [3, 4, 2, 1, 0]
    assert torch.equal(GROWING["gradient"](GRADIENT, at()), GRADIENT)


def test_growth_near_the_surface_in_spacings() -> None:
    # times e^0, e^-.5, e^-2, e^-8, e^-1250: 1, 1.213, .541, .0027, and 0 in float32
    assert order("sdf", at()) == [1, 0, 2, 3]
    wide = Placement(DISTANCE, torch.ones(5), 1.0, 3.0)  # all of them lie within a wide spacing
    assert order("sdf", wide) == order("gradient", wide)


def test_growth_of_gsdf_adds_nearness_to_the_gradient() -> None:
    # mean gradient 4; the last is e^-25 near
    score = GROWING["gsdf"](GRADIENT, at())
    assert torch.allclose(score, torch.tensor([5.0, 2 + 4 * 0.990050, 4 + 4 * 0.960789, 8 + 4 * 0.852144, 5.0]), atol=1e-4)
    assert order("gsdf", at()) == [3, 2, 1, 0, 4]
    still = GROWING["gsdf"](torch.tensor([0.0, 0.0, 2.0]), at(torch.tensor([0.0, 0.5, 0.5])))
    assert still[0] > 0.6 and still[1] < 1e-6  # near the surface one multiplies without any gradient


def test_growth_of_gaussianroom_is_barred_off_the_surface() -> None:
    # η > .95 where s < .3203 o
    assert order("gaussianroom", at()) == [3, 2, 1, 0]
    assert order("gaussianroom", at(opacity=0.1)) == [2, 1, 0]  # the bar is .032 there
    assert order("gaussianroom", at(opacity=0.0)) == [0]


def test_no_growth() -> None:
    assert order("none", at()) == []


def test_pruning_by_visibility_leaves_distances_alone() -> None:
    assert dropped("visibility", at()) == []


def test_pruning_in_spacings() -> None:
    assert dropped("sdf", at()) == [3, 4]
    assert dropped("sdf", Placement(DISTANCE, torch.ones(5), 0.01, 0.05)) == [4]


def test_pruning_of_gsdf_weighs_opacity_against_distance() -> None:
    # 1 - e^(-s²/.01) is 0, .010, .039, .148 and 1
    assert dropped("gsdf", at()) == [4]
    assert dropped("gsdf", at(opacity=0.1)) == [3, 4]
    assert dropped("gsdf", at(opacity=0.044)) == [2, 3, 4]  # .044 - .039 is just less than .005


def test_pruning_of_gaussianroom() -> None:
    # η < .005 where s > 3.2552 o
    assert dropped("gaussianroom", at()) == []
    assert dropped("gaussianroom", at(opacity=0.15)) == [4]
    assert dropped("gaussianroom", at(opacity=0.01)) == [3, 4]


def test_pruning_of_gsror2_is_fixed_in_the_unit_frame() -> None:
    assert dropped("gs-ror2", at()) == [3, 4]
    assert dropped("gs-ror2", Placement(DISTANCE, torch.ones(5), 1.0, 3.0)) == [3, 4]


def test_auto_grows_only_what_starts_coarse() -> None:
    assert growth("auto", "stereo")[0] == "none"
    assert [growth("auto", start)[0] for start in ("hull", "points", "sphere")] == ["gradient"] * 3
    assert growth("gsdf", "stereo")[0] == "gsdf"


@pytest.mark.parametrize(
    ("section", "field", "rules"), [(Train, "densify", {"auto", *GROWING}), (Train, "prune", PRUNING), (Refine, "prune", PRUNING)]
)
def test_profiles_can_name_every_rule(section: type[Section], field: str, rules: Iterable[str]) -> None:
    assert set(get_args(section.model_fields[field].annotation)) == set(rules)
