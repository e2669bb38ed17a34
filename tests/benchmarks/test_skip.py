"""The benchmark of left-out work: what cannot be had is a row with its reason, and a rule that is not there an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.skip import main, measure_run


def test_a_mode_that_cannot_be_had_is_a_row_with_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "capture" / "images"
    folder.mkdir(parents=True)
    for i in range(3):
        picture = np.random.default_rng(i).integers(0, 255, (40, 40, 3), np.uint8)
        Image.fromarray(picture).save(folder / f"p{i}.png")
    row = measure_run(tmp_path / "capture", "smoke", "masks", "always", tmp_path / "out", 1)
    assert (row.capture, row.rule, row.mode, row.choice) == ("capture", "masks", "always", "cannot be had")
    assert "3 of 3 photos have no mask" in row.evidence and row.seconds is None and row.chamfer_pct is None


def test_an_unknown_rule_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["built-in", "--rules", "photos,phots"])
    assert "there is no rule phots" in capsys.readouterr().err
