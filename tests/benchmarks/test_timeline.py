"""Error against time: the bake of a checkpoint, and checkpoints that are not available."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import timeline
from benchmarks.rows import Row, read_csv, write_csv
from gsbake.errors import UsageError

OLD = Row("elsewhere", "gsbake", "preview", "hull", 10, 5.0, 1.0, 0.9, 9.0)


@pytest.mark.parametrize(("start", "stereo"), [("stereo", "auto"), ("sphere", "never")])
def test_a_checkpoint_is_a_share_of_the_profile(tmp_path: Path, start: str, stereo: str) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").touch()
    session = timeline.Checkpoint("thing", tmp_path, "preview", start, 0.5).open(tmp_path / "out", 1)
    settings = session.profile.profile
    assert (settings.train.iterations, settings.refine.iterations) == (175, 20)
    assert (settings.train.init, settings.stereo.enabled) == (start, stereo)
    assert session.out == tmp_path / "out" / "thing"  # all initialisations share one output folder


def test_missing_captures_are_skipped_with_a_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(timeline, "CAPTURES", tmp_path)
    (tmp_path / "blind").mkdir()
    write_csv(tmp_path / "t.csv", [OLD])
    timeline.main(["--captures", "gone,blind", "--csv", str(tmp_path / "t.csv"), "--charts", str(tmp_path), "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "gone: skipped; " in printed and "GSBAKE_CAPTURES" in printed and "blind: skipped; " in printed and "no ground truth" in printed
    assert "| elsewhere | preview, from hull |" in printed  # the Pareto front of the rows in the file
    assert read_csv(tmp_path / "t.csv") == [OLD]


def test_an_unavailable_initialisation_has_no_row(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def refuse(*_: object) -> Row:
        raise UsageError("the initialisation was hull (few points).")

    monkeypatch.setattr(timeline, "run_checkpoint", refuse)
    assert timeline.run_series("thing", tmp_path, "preview", "points", [0.0, 1.0], tmp_path, 1) == []
    assert capsys.readouterr().out.count("skipped; the initialisation was hull") == 1


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_built_in_capture_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = ["--csv", str(tmp_path / "t.csv"), "--charts", str(tmp_path), "--out", str(tmp_path / "out")]
    timeline.main(["--captures", "built-in", "--profiles", "smoke", "--starts", "hull,sphere", "--shares", "0", "--no-peers", *places])
    (hull,) = read_csv(tmp_path / "t.csv")
    assert (hull.start, hull.steps) == ("hull", 0)
    assert hull.chamfer_pct is not None and hull.chamfer_pct < 2 and hull.seconds > 0 and hull.peak_mb
    # Without training the sphere lies outside the object, so nothing of it is left to mesh.
    assert "built-in, smoke, from sphere: skipped; refine: " in capsys.readouterr().out
    assert "smoke, from hull" in (tmp_path / "error-time-built-in.svg").read_text()
