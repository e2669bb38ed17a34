"""Densification and pruning policies on a few surfels, against results calculated by hand."""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

import pytest
import torch
from torch import Tensor

from gsbake.config.schema import Refine, Section, Train
from gsbake.surfels.densification.policy import PolicyInputs
from gsbake.surfels.densification.registry import DENSIFICATION, PRUNING, choose_densification

#: Spacing .01: on the surface, one, two, four and fifty spacings off it.
DISTANCE = torch.tensor([0.0, 0.01, 0.02, 0.04, 0.5])
GRADIENT = torch.tensor([1.0, 2.0, 4.0, 8.0, 5.0])


def at(distance: Tensor = DISTANCE, opacity: float = 1.0) -> PolicyInputs:
    return PolicyInputs(distance, torch.full_like(distance, opacity), 0.01, 0.03)


def order(name: str, placement: PolicyInputs) -> list[int]:
    """Surfels that are densified, highest score first."""
    score = DENSIFICATION[name](GRADIENT, placement)
    return [i for i in torch.argsort(score, descending=True, stable=True).tolist() if score[i] > 0]


def dropped(name: str, placement: PolicyInputs) -> list[int]:
    return PRUNING[name](placement).nonzero()[:, 0].tolist()


def test_gradient_score() -> None:
    assert order("gradient", at()) == [3, 4, 2, 1, 0]
    assert torch.equal(DENSIFICATION["gradient"](GRADIENT, at()), GRADIENT)


def test_sdf_guided_score_is_relative_to_the_spacing() -> None:
    # times e^0, e^-.5, e^-2, e^-8, e^-1250: 1, 1.213, .541, .0027, and 0 in float32
    assert order("sdf", at()) == [1, 0, 2, 3]
    wide = PolicyInputs(DISTANCE, torch.ones(5), 1.0, 3.0)  # all within one spacing
    assert order("sdf", wide) == order("gradient", wide)


def test_gsdf_score_adds_proximity_to_the_gradient() -> None:
    # mean gradient 4; the proximity of the last is e^-25
    score = DENSIFICATION["gsdf"](GRADIENT, at())
    assert torch.allclose(score, torch.tensor([5.0, 2 + 4 * 0.990050, 4 + 4 * 0.960789, 8 + 4 * 0.852144, 5.0]), atol=1e-4)
    assert order("gsdf", at()) == [3, 2, 1, 0, 4]
    still = DENSIFICATION["gsdf"](torch.tensor([0.0, 0.0, 2.0]), at(torch.tensor([0.0, 0.5, 0.5])))
    assert still[0] > 0.6 and still[1] < 1e-6  # a surfel near the surface is densified without any gradient


def test_gaussianroom_score_is_zero_off_the_surface() -> None:
    # η > .95 where s < .3203 o
    assert order("gaussianroom", at()) == [3, 2, 1, 0]
    assert order("gaussianroom", at(opacity=0.1)) == [2, 1, 0]  # up to a distance of .032
    assert order("gaussianroom", at(opacity=0.0)) == [0]


def test_disabled_densification() -> None:
    assert order("none", at()) == []


def test_visibility_pruning_ignores_distances() -> None:
    assert dropped("visibility", at()) == []


def test_sdf_guided_pruning_is_relative_to_the_spacing() -> None:
    assert dropped("sdf", at()) == [3, 4]
    assert dropped("sdf", PolicyInputs(DISTANCE, torch.ones(5), 0.01, 0.05)) == [4]


def test_gsdf_pruning_compares_opacity_and_distance() -> None:
    # 1 - e^(-s²/.01) is 0, .010, .039, .148 and 1
    assert dropped("gsdf", at()) == [4]
    assert dropped("gsdf", at(opacity=0.1)) == [3, 4]
    assert dropped("gsdf", at(opacity=0.044)) == [2, 3, 4]  # .044 - .039 is just less than .005


def test_gaussianroom_pruning() -> None:
    # η < .005 where s > 3.2552 o
    assert dropped("gaussianroom", at()) == []
    assert dropped("gaussianroom", at(opacity=0.15)) == [4]
    assert dropped("gaussianroom", at(opacity=0.01)) == [3, 4]


def test_gs_ror2_pruning_is_fixed_in_the_unit_frame() -> None:
    assert dropped("gs-ror2", at()) == [3, 4]
    assert dropped("gs-ror2", PolicyInputs(DISTANCE, torch.ones(5), 1.0, 3.0)) == [3, 4]


def test_auto_densifies_only_coarse_initialisations() -> None:
    assert choose_densification("auto", "stereo")[0] == "none"
    assert [choose_densification("auto", start)[0] for start in ("hull", "points", "sphere")] == ["gradient"] * 3
    assert choose_densification("gsdf", "stereo")[0] == "gsdf"


@pytest.mark.parametrize(
    ("section", "field", "policies"), [(Train, "densify", {"auto", *DENSIFICATION}), (Train, "prune", PRUNING), (Refine, "prune", PRUNING)]
)
def test_settings_accept_every_policy(section: type[Section], field: str, policies: Iterable[str]) -> None:
    assert set(get_args(section.model_fields[field].annotation)) == set(policies)
