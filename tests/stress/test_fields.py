"""Every field on hostile surfels, points and photos, with all couplings on at once: it stays finite."""

from __future__ import annotations

import os
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsbake.config.schema import Coupling, DistanceField, Loss, Profile, Train
from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.surfels.adam import Adam
from gsbake.surfels.densification.seeding import place_anew, seed_gaps
from gsbake.surfels.field import Field
from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.known import KnownDistance
from gsbake.surfels.fields.registry import FIELDS, make_field
from gsbake.surfels.finite import first_non_finite
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.training.trainer import Plan, Trainer
from tests.stress.test_training import KINDS, MOST_SURFELS, SIZE, views
from tests.support.slow import slow

ALL = ("samples", *FIELDS)
STEPS = int(os.environ.get("GSBAKE_SOAK_STEPS", "20000")) // 10
SMALL = {
    "resolution": 24, "levels": 3, "table_bits": 10, "rank": 2, "octaves": 2, "width": 8, "fit_steps": 20, "rays": 40, "ray_samples": 6,
    "points": 64, "edges": 0.5, "seeds": 0.1, "cycles": 1,
}  # fmt: skip
#: Every coupling at once.
COUPLING = dict.fromkeys(Coupling.model_fields, 0.3)


def surfels(kind: str) -> Surfels:
    points = fibonacci_sphere(200)
    s = create(0.7 * points, points, 0.7 * spacing(points), None, "colour", 0, 0.1, 5.0)
    if kind == "empty":
        return s.select(torch.zeros(0, dtype=torch.long))
    if kind == "one":
        return s.select(torch.tensor([3]))
    if kind == "one place":
        s.position[:] = 0.2
    elif kind == "plane":
        s.position[:, 2] = 0
    elif kind == "nan":
        s.position[::3], s.quaternion[1::3], s.sdf[::5] = float("nan"), float("nan"), float("nan")
    elif kind == "all nan":
        s.position[:] = float("nan")
    elif kind == "inf":
        s.position[::3], s.sdf[::5] = float("inf"), -float("inf")
    elif kind == "no direction":
        s.quaternion[:] = 0
    elif kind.startswith("scale"):
        factor = float(kind.split()[1])
        s.position *= factor
        s.log_scale += float(np.log(factor))
    return s


SURFELS = (
    "plain", "empty", "one", "one place", "plane", "nan", "all nan", "inf", "no direction", "scale 1e-8", "scale 1e-4", "scale 10",
    "scale 1e4",
)  # fmt: skip
#: Quick are the field of the surfels themselves with all, and every field where some are not numbers.
CASES = [
    pytest.param(kind, what, marks=() if kind == "samples" or what == "nan" else pytest.mark.slow) for what in SURFELS for kind in ALL
]
POINTS = torch.tensor([
    [0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [1e-30, 0.0, 0.0], [1e6, 0.0, -1e6], [float("nan"), 0.0, 0.0], [float("inf"), 0.0, 0.0],
    [0.0, -float("inf"), float("nan")],
])  # fmt: skip


def profile(kind: str) -> SimpleNamespace:
    field = DistanceField(**{"kind": kind, **SMALL}, opacity="field" if kind in ("hash", "grid") else "own", splats=kind == "hash")
    return SimpleNamespace(field=field, coupling=Coupling(**COUPLING), loss=Loss(), train=Train(sharpness="spacing", band=1.0))


@pytest.mark.parametrize(("kind", "what"), CASES)
def test_a_field_of_hostile_surfels_is_finite(kind: str, what: str) -> None:
    s = surfels(what)
    field: Field = make_field(s, profile(kind), 0)
    with torch.no_grad():
        f, g, moved = field.value(POINTS), field.gradient(POINTS), field.project(POINTS)
        assert torch.isfinite(f).all() and torch.isfinite(g).all() and torch.isfinite(moved[:4]).all()
        generator = torch.Generator().manual_seed(0)
        points, normals = field.sample_near_zero(50, generator)
        assert torch.isfinite(points).all() and torch.isfinite(normals).all() and points.shape == normals.shape
        lattice = BlockLattice([-1.0] * 3, [1.0] * 3, 0.25)
        lattice.allocate_all()
        values = field.mesh(lattice, 0.5)
        known = values[np.isfinite(values)]
        assert len(known) == 0 or np.abs(known).max() <= 1
        if what in ("plain", "one", "plane"):
            more, _ = seed_gaps(s, Adam(), field, 0.5, generator)
            anew, _ = place_anew(s, Adam(), field, generator)
            assert first_non_finite(more.tensors()) is None and first_non_finite(anew.tensors()) is None
    for share in (0.0, 0.3, 0.6, 1.0):
        field.advance(share)
    assert torch.isfinite(field.value(POINTS)).all()


def trainer(kind: str, photos: str, steps: int) -> Trainer:
    body = {
        "train": {"iterations": steps, "max_size": SIZE, "holdout": 0, "lr_position": 5e-3, "sharpness": "spacing", "reset_opacity": 0.5},
        "surfels": {"max_count": MOST_SURFELS, "projected_depth": True},
    }
    p = Profile.model_validate(body)
    s = surfels("plain")
    field = make_field(s, profile(kind), 0)
    plan = Plan(p.train, p.surfels, p.loss, steps, 0.3, True, 0)
    return Trainer(plan, s, None, views(photos, SIZE), views(photos, SIZE // 2), [], field=field)


def soak(kind: str, photos: str, steps: int) -> None:
    t = trainer(kind, photos, steps)
    while t.done < t.end:
        t.step()
    assert first_non_finite(t.surfels.tensors()) is None
    assert first_non_finite(dict(t.field.parameters())) is None
    assert np.isfinite(t.evaluate())


@pytest.mark.parametrize("kind", ["grid", *(slow(kind) for kind in ALL if kind != "grid")])
def test_all_couplings_at_once_stay_finite(kind: str) -> None:
    soak(kind, "random photos", 40)


@pytest.mark.stress
@pytest.mark.timeout(0)
@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("photos", KINDS)
def test_long_soak_of_all_couplings(kind: str, photos: str) -> None:
    """A tenth of GSBAKE_SOAK_STEPS steps (2 000 when unset)."""
    soak(kind, photos, STEPS)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_known_distance_ignores_points_that_are_not_finite(bad: float) -> None:
    points = fibonacci_sphere(500)
    spoilt = points.copy()
    spoilt[::5] = bad
    known = KnownDistance(spoilt, points)
    assert np.isfinite(known(np.concatenate([points, [[bad] * 3]]))).all()


def test_a_field_that_is_not_finite_is_named() -> None:
    t = trainer("grid", "random photos", 30)
    assert isinstance(t.field, ContinuousField)
    t.step()
    next(iter(t.field.parameters().values())).view(-1)[:] = float("nan")
    with pytest.raises(FloatingPointError, match=r"field\.coarse"):
        for _ in range(5):
            t.step()
