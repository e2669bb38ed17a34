"""Early stopping: plateau detection, and the trainer's cooldown."""

from __future__ import annotations

import pytest
import torch

from gsbake.config.schema import Profile
from gsbake.surfels.initialisation import fibonacci_sphere
from gsbake.surfels.model import create
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.training.early_stopping import MAX_PSNR_GAIN, WINDOW, has_plateaued
from gsbake.surfels.training.trainer import COOLDOWN_SHARE, Plan, Trainer
from gsbake.surfels.views import TrainView

STEPS = 200


def rows(psnr: list[float], median: list[float]) -> list[dict[str, float]]:
    return [{"step": 10.0 * i, "psnr": p, "sdf_median": m} for i, (p, m) in enumerate(zip(psnr, median, strict=True))]


@pytest.mark.parametrize(
    ("psnr", "median", "plateau"),
    [
        ([30.0, 30.1, 30.1, 30.12], [0.01] * 4, True),
        ([30.0, 30.1, 30.1, 30.1 + MAX_PSNR_GAIN + 0.01], [0.01] * 4, False),  # PSNR still rises
        ([30.0, 30.1, 30.1, 30.1], [0.01, 0.01, 0.01, 0.0097], False),  # the SDF median still falls
        ([30.0, 30.1, 30.1], [0.01] * 3, False),  # too few evaluations
        ([20.0, 25.0, 30.0, 30.1, 30.1, 30.1], [0.1, 0.05, 0.01, 0.01, 0.01, 0.01], True),  # only the last rows count
    ],
)
def test_plateau_detection(psnr: list[float], median: list[float], plateau: bool) -> None:
    holds, evidence = has_plateaued(rows(psnr, median))
    assert holds is plateau and (f"{len(psnr)} evaluations" in evidence or "dB" in evidence)


def trainer(mode: str) -> Trainer:
    """A trainer of a few surfels and one black photo; the tests take no steps."""
    p = Profile()
    points = fibonacci_sphere(20)
    black = torch.zeros(3, 8, 8, dtype=torch.uint8)
    away = torch.tensor([0.0, 0.0, 3.0])
    view = TrainView("a", black, None, torch.eye(3), away, -away, Pinhole(8, 8, 8.0, 8.0, 4.0, 4.0))
    surfels = create(points, points, torch.full((20,), 0.1).numpy(), None, "colour", 0, 0.01, 5.0)
    return Trainer(Plan(p.train, p.surfels, p.loss, STEPS, 0.1, False, 0, mode), surfels, None, [view], [view], [])


@pytest.mark.parametrize(("mode", "gain", "stop"), [("auto", 0.0, 80), ("auto", 1.0, None), ("keep", 0.0, None), ("skip", 1.0, 20)])
def test_training_cools_down_at_a_plateau(monkeypatch: pytest.MonkeyPatch, mode: str, gain: float, stop: int | None) -> None:
    t = trainer(mode)
    monkeypatch.setattr(t, "evaluate", lambda: 30.0 + gain * t.done)
    stopped = None
    for done in range(20, STEPS + 1, 20):  # at full resolution from the first evaluation on; the fourth has ROWS to compare
        t.done = done
        t.record()
        stopped = done if stopped is None and t.cooldown_start is not None else stopped
    assert stopped == stop and WINDOW == 4
    assert t.end == (STEPS if stop is None else stop + int(COOLDOWN_SHARE * STEPS))
