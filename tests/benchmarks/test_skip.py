"""Ablation of the skip rules: failed modes, unknown rules, reused stages, rows of other runs, CPU time."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.skip import CpuClock, Row, main, measure_run, reuse, write
from gsbake.errors import UsageError
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.store import Artifact


def test_a_failed_run_is_a_row_with_the_reason(tmp_path: Path) -> None:
    folder = tmp_path / "capture" / "images"
    folder.mkdir(parents=True)
    for i in range(2):
        picture = np.random.default_rng(i).integers(0, 255, (40, 40, 3), np.uint8)
        Image.fromarray(picture).save(folder / f"p{i}.png")
    row = measure_run(tmp_path / "capture", "smoke", "resolution", "skip", tmp_path / "out", 1)
    assert (row.capture, row.rule, row.mode, row.choice) == ("capture", "resolution", "skip", "failed")
    assert "has 2 usable photos" in row.evidence and row.seconds is None and row.chamfer_pct is None


def test_an_unknown_rule_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["built-in", "--rules", "resolution,resolutions"])
    assert "there is no rule resolutions" in capsys.readouterr().err


def test_early_stages_of_another_run_are_copied_and_the_run_stays_unchanged(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    for name in ("stages/poses/abc/manifest.json", "stages/poses/abc.checkpoint/half", "stages/train/def/manifest.json"):
        (run / name).parent.mkdir(parents=True)
        (run / name).write_text("theirs")
    reuse(run, out)
    assert [p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()] == ["stages/poses/abc/manifest.json"]
    (out / "stages/poses/abc/manifest.json").write_text("ours")
    reuse(run, out)
    assert (out / "stages/poses/abc/manifest.json").read_text() == "ours"
    assert (run / "stages/poses/abc/manifest.json").read_text() == "theirs"


def test_a_run_without_early_stages_cannot_be_reused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no finished early stages"):
        reuse(tmp_path, tmp_path / "out")


def test_rows_of_other_runs_are_kept(tmp_path: Path) -> None:
    file = tmp_path / "skip.csv"
    write(file, [Row("cup", "preview", "settled", "keep", "old", "", seconds=1.0), Row("cup", "preview", "photos", "keep", "kept", "")])
    write(file, [Row("cup", "preview", "settled", "keep", "new", "", seconds=2.25), Row("jug", "preview", "settled", "keep", "more", "")])
    with file.open(newline="") as body:
        lines = [(line["capture"], line["choice"], line["seconds"]) for line in csv.DictReader(body)]
    assert lines == [("cup", "kept", ""), ("cup", "new", "2.25"), ("jug", "more", "")]


def test_cpu_time_of_a_stages_process_is_stored(tmp_path: Path) -> None:
    def state(name: str) -> StageState:
        return StageState(name, name, "run", (), None, Artifact(tmp_path / name / "key", {}, {}))

    clock, train = CpuClock(tmp_path / "cpu.json"), state("train")
    clock.stage_started(train)
    subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 0.5: pass"], check=True)
    clock.stage_finished(train)
    assert clock.total([train]) > 0.4  # CPU time, independent of other processes
    assert CpuClock(tmp_path / "cpu.json").total([train, state("mesh")]) == clock.total([train])
