"""The table of what hulls leave out, by groups of photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import rigidity
from gsbake.synth.capture import look_at


def test_table_of_a_square_that_grew() -> None:
    """Eight photos around a square that is twice as wide in the last four."""
    places = [np.array([3 * np.cos(a), 3 * np.sin(a), 0.5]) for a in np.deg2rad(45 * np.arange(8.0))]
    cameras = [look_at(f"{k}", place, np.zeros(3), 0.0, 150.0, (40.0, 40.0), 80) for k, place in enumerate(places)]
    masks = [np.zeros((80, 80), np.uint8) for _ in cameras]
    for k, mask in enumerate(masks):
        half = 8 if k < 4 else 16
        mask[40 - half : 40 + half, 40 - half : 40 + half] = 255
    lines = rigidity.table(cameras, masks, 2).splitlines()
    own, every = (float(cell.split("%")[0]) for cell in lines[3].split("|")[2:4])
    assert lines[2].startswith("| 0 to 3 |") and lines[3].startswith("| 4 to 7 |") and own < 1 and every > 20


def test_runs_that_cannot_be_measured_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rigidity.main([str(tmp_path)]) != 0
    assert "no finished stage poses" in capsys.readouterr().err
