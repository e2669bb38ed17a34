"""Surfels on the zero level set: in its gaps, and all of them anew."""

from __future__ import annotations

import torch

from gsbake.surfels.adam import Adam
from gsbake.surfels.densification.seeding import place_anew, seed_gaps, thin
from gsbake.surfels.fields.registry import make_field
from tests.surfels.fields.test_continuous import RADIUS, ball, profile


def adam_of(surfels) -> Adam:  # type: ignore[no-untyped-def]
    adam = Adam()
    for name, x in surfels.tensors().items():
        adam.step(name, x.clone(), torch.ones_like(x), 1e-3)
    return adam


def test_gaps_are_filled_and_nothing_else() -> None:
    whole = ball(1500)
    field = make_field(whole, profile("grid"), 0)
    cap = whole.position[:, 0] > 0.4
    holed = whole.select((~cap).nonzero()[:, 0])
    adam = adam_of(holed)
    filled, count = seed_gaps(holed, adam, field, 0.3, torch.Generator().manual_seed(0))
    added = filled.position[len(holed) :]
    assert count == len(added) > 0.3 * int(cap.sum())
    assert torch.equal(filled.position[: len(holed)], holed.position)
    assert float((added.norm(dim=1) - RADIUS).abs().max()) < 0.01 and float(added[:, 0].min()) > 0.3
    normals = filled.normal()[len(holed) :]
    assert float((normals * torch.nn.functional.normalize(added, dim=1)).sum(1).min()) > 0.97
    assert adam.first["position"].shape == filled.position.shape and not adam.first["position"][len(holed) :].any()
    _, none = seed_gaps(whole, adam_of(whole), field, 0.3, torch.Generator().manual_seed(0))
    assert none < 0.02 * len(whole)


def test_all_are_placed_anew_on_the_zero_level_set() -> None:
    surfels = ball(1500)
    field = make_field(surfels, profile("grid"), 0)
    surfels.position += 0.05 * torch.randn(surfels.position.shape, generator=torch.Generator().manual_seed(0))
    placed, count = place_anew(surfels, adam_of(surfels), field, torch.Generator().manual_seed(0))
    assert count == len(placed) and 0.8 * 1500 < count <= 1500
    assert float((placed.position.norm(dim=1) - RADIUS).abs().max()) < 0.01
    assert set(placed.attributes) == set(surfels.attributes)
    again, _ = place_anew(surfels, adam_of(surfels), field, torch.Generator().manual_seed(0))
    assert torch.equal(again.position, placed.position)


def test_thinning_leaves_one_point_a_cell() -> None:
    points = torch.tensor([[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [0.12, 0.0, 0.0], [0.03, 0.0, 0.0]])
    assert thin(points, 0.1).tolist() == [0, 2]
