"""Which surfels multiply and which are dropped: the rules of the family that need no more than a distance, selectable by name.

Every rule is a pure function of what is known of the surfels. They differ in what they make of the distance from the surface: nothing
(3DGS, Kerbl et al. 2023), widths fixed in the unit frame (GSDF, Yu et al. 2024; GaussianRoom, Xiang et al. 2024; GS-ROR², Zhu et al. 2024),
or widths in surfel spacings, which fit objects of any detail. What they are worth: docs/decisions/0008-densify-policies.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

#: GSDF: the square of the distance (unit frame) that counts as near the surface, and the least opacity that must be left.
GSDF_SQUARE, GSDF_FLOOR = 0.01, 0.005
#: GaussianRoom: η above which surfels may multiply, and η that is too small to stay (the source says no more than "small").
ROOM_NEAR, ROOM_FAR = 0.95, 0.005
#: GS-ROR²: a surfel farther than this (unit frame) from the zero set is dropped.
ROR_BOUND = 0.03


@dataclass(frozen=True)
class Placement:
    """Where n surfels stand: `distance` (n,) ≥ 0 from the surface in the unit frame, 0 where it is not known; `opacity` (n,) in 0..1 as
    a share of the transfer's peak; `spacing`, the typical distance between neighbours; `far`, the distance that is too far."""

    distance: Tensor
    opacity: Tensor
    spacing: float
    far: float


def _gsdf_nearness(at: Placement) -> Tensor:
    return torch.exp(-(at.distance**2) / GSDF_SQUARE)


def _room_nearness(at: Placement) -> Tensor:
    """η = exp(−s²/(2o²)): what is opaque may lie farther off than what is nearly transparent."""
    return torch.exp(-(at.distance**2) / (2 * at.opacity.clamp_min(1e-6) ** 2))


# -- growing: score (n,) from the mean screen gradient (n,); the highest scores multiply, a score of 0 never does -------------------------


def grow_gradient(gradient: Tensor, at: Placement) -> Tensor:
    """The mean screen gradient alone (3DGS, and DSDF after it)."""
    return gradient


def grow_sdf(gradient: Tensor, at: Placement) -> Tensor:
    """The gradient times exp(−s²/2d²), d the spacing: what is off the surface by more than its neighbours are has a gradient because
    it is in the wrong place, not because there are too few."""
    return gradient * torch.exp(-(at.distance**2) / (2 * at.spacing**2))


def grow_gsdf(gradient: Tensor, at: Placement) -> Tensor:
    """gradient + ω exp(−s²/.01) (GSDF). ω is the mean gradient, so that it needs no constant in the loss's units."""
    return gradient + gradient.mean() * _gsdf_nearness(at)


def grow_gaussianroom(gradient: Tensor, at: Placement) -> Tensor:
    """The gradient where η > .95, else 0 (GaussianRoom)."""
    return torch.where(_room_nearness(at) > ROOM_NEAR, gradient, 0.0)


def grow_none(gradient: Tensor, at: Placement) -> Tensor:
    """Nothing multiplies."""
    return torch.zeros_like(gradient)


def growth(asked: str, start: str) -> tuple[str, str]:
    """The rule of `GROWING` that `train.densify` asks for, for surfels that start from `start` ("stereo", "hull", …), and why."""
    if asked != "auto":
        return asked, "asked for by the profile"
    if start == "stereo":
        return "none", "stereo points are spread evenly, and more surfels than they give cost more than they show"
    return "gradient", f"a start from {start} is coarse: where it does not fit the photos it needs more surfels"


# -- pruning: which surfels (n,) are too far from the surface -----------------------------------------------------------------------------


def prune_visibility(at: Placement) -> Tensor:
    """None for its distance: opacity, size and visibility alone decide (3DGS)."""
    return torch.zeros_like(at.distance, dtype=torch.bool)


def prune_sdf(at: Placement) -> Tensor:
    """Farther off than so many spacings: GS-ROR²'s rule without a constant of the scene."""
    return at.distance > at.far


def prune_gsdf(at: Placement) -> Tensor:
    """Opacity − (1 − exp(−s²/.01)) < .005 (GSDF, whose opacity is the mean over N steps; here the present one)."""
    return at.opacity - (1 - _gsdf_nearness(at)) < GSDF_FLOOR


def prune_gaussianroom(at: Placement) -> Tensor:
    """η below .005 (GaussianRoom)."""
    return _room_nearness(at) < ROOM_FAR


def prune_gsror2(at: Placement) -> Tensor:
    """|s| > .03 (GS-ROR²)."""
    return at.distance > ROR_BOUND


Grow = Callable[[Tensor, Placement], Tensor]
Prune = Callable[[Placement], Tensor]

#: The rules by the names that `train.densify` takes beside "auto".
GROWING: dict[str, Grow] = {
    "gradient": grow_gradient,
    "sdf": grow_sdf,
    "gsdf": grow_gsdf,
    "gaussianroom": grow_gaussianroom,
    "none": grow_none,
}
#: The rules by the names that `train.prune` and `refine.prune` take.
PRUNING: dict[str, Prune] = {
    "visibility": prune_visibility,
    "sdf": prune_sdf,
    "gsdf": prune_gsdf,
    "gaussianroom": prune_gaussianroom,
    "gs-ror2": prune_gsror2,
}
