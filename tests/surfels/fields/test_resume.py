"""A run that is interrupted and resumed gives the same bytes as an uninterrupted one, for every field and with all couplings on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gsbake.checkpoint import load_checkpoint, save_checkpoint
from gsbake.surfels.fields.registry import save_field
from gsbake.surfels.training.trainer import Trainer
from tests.stress.test_fields import ALL, trainer

STEPS = 120  # one densification, one cycle of placing anew, several allocations


def finish(t: Trainer) -> None:
    while t.done < t.end:
        t.step()


def files(t: Trainer, folder: Path) -> dict[str, bytes]:
    folder.mkdir()
    with torch.no_grad():
        t.field.distance(t.surfels)
        t.field.settle(t.surfels)
    t.surfels.save(folder / "surfels.safetensors")
    save_field(folder, t.field)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=() if kind == "grid" else pytest.mark.slow) for kind in ALL])
def test_resumed_equals_uninterrupted(kind: str, tmp_path: Path) -> None:
    whole = trainer(kind, "random photos", STEPS)
    finish(whole)
    first = trainer(kind, "random photos", STEPS)
    while first.done < 37:
        first.step()
    save_checkpoint(tmp_path / "c", first.state())
    second = trainer(kind, "random photos", STEPS)
    second.restore(load_checkpoint(tmp_path / "c"))
    finish(second)
    assert files(second, tmp_path / "second") == files(whole, tmp_path / "whole")
