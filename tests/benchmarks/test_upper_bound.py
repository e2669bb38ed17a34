"""Upper bound of materials: what a run must have."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.upper_bound import lay_true_maps, main
from gsbake.errors import UsageError


def test_an_unfinished_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="has no finished stage ingest"):
        lay_true_maps(tmp_path / "run", tmp_path, tmp_path / "out")
    assert main([str(tmp_path / "run"), str(tmp_path), str(tmp_path / "out")]) == UsageError.exit_code
    assert "run `gsbake run` to its end first" in capsys.readouterr().err
