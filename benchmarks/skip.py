"""Ablation of the rules of `[skip]`: time and error with each rule on and off.

python -m benchmarks.skip CAPTURE [--profile preview] [--rules resolution,specular] [--modes keep] [--reuse RUN] [--out DIR] [--csv FILE]

CAPTURE is a folder of photos, or `built-in` for the capture of `gsbake synth`. The first run has every rule at auto; then each rule is set
to each of the other modes, in the same output folder, so that unaffected stages are cached. `--reuse` copies the stages up to stereo of a
finished run of the same photos and profile there first.

Seconds are wall time from the stages' manifests, cached stages included: the time of a run without cache. CPU seconds are those of the
stages' processes that ran here; reused stages are in no row, so rows of one output folder are comparable. If the capture has ground truth,
the mesh is compared with it (`benchmarks.truth`); PSNR and bytes are those of the asset, from the report. A mode that fails is a row with
the reason. Rows of other runs in the CSV are kept.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.csv_rows import today
from benchmarks.timeline import BUILT_IN, ROOT, find_capture, manifests, names
from benchmarks.truth import measure_stage, read_truth
from gsbake.api import RunOptions, open_session
from gsbake.config.schema import Skip
from gsbake.errors import BadInputError, UsageError
from gsbake.monitor import SKIP_PREFIX
from gsbake.pipeline.engine import Observer
from gsbake.pipeline.plan import StageState

RESULTS = ROOT / "benchmarks" / "results" / "skip.csv"
#: Stages that `--reuse` copies from another run.
REUSED_STAGES = ("ingest", "poses", "stereo")


@dataclass(frozen=True)
class Row:
    """One run: rule, decision and evidence, total time and quality; None where there is no such figure.

    `said_s` is the saved time in seconds that the run reports for this rule.
    """

    capture: str
    profile: str
    rule: str
    mode: str
    choice: str
    evidence: str
    said_s: float | None = None
    seconds: float | None = None
    cpu_s: float | None = None
    chamfer_pct: float | None = None
    normal_deg: float | None = None
    psnr: float | None = None
    megabytes: float | None = None
    date: str = field(default_factory=today)


class CpuClock(Observer):
    """CPU seconds of each stage's process, by stage and key, stored in `file` for runs in which the stage is cached."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.spent: dict[str, float] = json.loads(file.read_text()) if file.is_file() else {}
        self._begun = 0.0

    def stage_started(self, state: StageState) -> None:
        """Store the CPU time of ended processes."""
        self._begun = _children()

    def stage_finished(self, state: StageState) -> None:
        """Store the difference as that of the stage."""
        self.spent[_stage_key(state)] = _children() - self._begun
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(json.dumps(self.spent, indent=1))

    def total(self, states: Sequence[StageState]) -> float:
        """CPU seconds of the stages that ran under this clock."""
        return sum(self.spent.get(_stage_key(state), 0.0) for state in states)


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _stage_key(state: StageState) -> str:
    assert state.artifact is not None
    return f"{state.name}/{state.artifact.folder.name}"


def reuse(run: Path, out: Path, stages: Sequence[str] = REUSED_STAGES) -> None:
    """Copy finished `stages` of `run` to the output folder `out` where missing. Raises UsageError when `run` has none.
    """
    found = [folder for stage in stages for folder in (run / "stages" / stage).glob("*") if (folder / "manifest.json").is_file()]
    if not found:
        raise UsageError(f"{run} holds no finished early stages; give the output folder of a finished run.")
    for folder in found:
        target = out / folder.relative_to(run)
        if not target.exists():
            shutil.copytree(folder, target)


def measure_run(folder: Path, profile: str, rule: str, mode: str, out: Path, threads: int) -> Row:
    """Run all stages (or use cached ones) with one rule set, and measure the result."""
    overrides = [f"{SKIP_PREFIX}{rule}={mode}"] if rule else []
    options = RunOptions(photos=folder, out=out, profile=profile, overrides=overrides, device="cpu", threads=threads)
    clock = CpuClock(out / "cpu.json")
    try:
        states = open_session(options, clock).engine.run("report")
    except BadInputError as error:
        return Row(folder.name, profile, rule, mode, "failed", str(error))
    done = manifests(states)
    folders = {s.name: s.artifact.folder for s in states if s.artifact is not None}
    mine = [d for m in done.values() for d in m["decisions"] if d["what"] == SKIP_PREFIX + rule]
    saved = [d["saved_s"] for d in mine if "saved_s" in d]
    figures = None
    try:
        read_truth(folder)
        figures = measure_stage(folders["mesh"] / "mesh.ply", folders["poses"], folder)
    except UsageError as error:
        sys.stderr.write(f"{folder.name}: not compared with ground truth: {error}\n")
    return Row(
        capture=folder.name,
        profile=profile,
        rule=rule or "all",
        mode=mode,
        choice="; ".join(d["choice"] for d in mine),
        evidence="; ".join(d["evidence"] for d in mine),
        said_s=sum(saved) if saved else None,
        seconds=sum(m["seconds"] for m in done.values()),
        cpu_s=clock.total(states),
        chamfer_pct=figures.chamfer_pct if figures else None,
        normal_deg=figures.normal_deg if figures else None,
        psnr=done["report"]["results"]["psnr"],
        megabytes=done["report"]["results"]["bytes"] / 1e6,
    )


def show(row: Row) -> None:
    """Print a row."""

    def text(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    spent = f"{text(row.seconds, '7.1f')} s  CPU {text(row.cpu_s, '6.1f')} s"
    errors = f"Chamfer {text(row.chamfer_pct, '.3f')} %  normals {text(row.normal_deg, '.2f')}°  PSNR {text(row.psnr, '.2f')} dB"
    sys.stdout.write(f"{row.capture:16} {row.rule:16} {row.mode:6} {spent}  {errors}  {text(row.megabytes, '.2f')} MB  {row.choice}\n")
    sys.stdout.flush()


def write(path: Path, rows: Sequence[Any], digits: int = 4) -> None:
    """Write dataclass rows; the first four columns are their key. Other rows of the file are kept before them."""
    table = [{k: round(v, digits) if isinstance(v, float) else v for k, v in asdict(row).items()} for row in rows]
    columns = list(table[0])
    again = {tuple(line[column] for column in columns[:4]) for line in table}
    old: list[dict[str, str]] = []
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            old = [line for line in csv.DictReader(file) if tuple(line[column] for column in columns[:4]) not in again]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*old, *table])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print every row, and write the CSV after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture")
    parser.add_argument("--profile", default="preview")
    parser.add_argument("--rules", type=names, default=list(Skip.model_fields))
    parser.add_argument("--modes", type=names, default=["keep"], help="besides auto: keep, skip")
    parser.add_argument("--threads", type=int, default=0, help="0: the physical cores")
    parser.add_argument("--reuse", type=Path, help="finished run of the same photos and profile, whose early stages are copied")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "skip", help="folder of the runs")
    parser.add_argument("--csv", type=Path, default=RESULTS)
    args = parser.parse_args(arguments)
    if unknown := set(args.rules) - set(Skip.model_fields):
        parser.error(f"there is no rule {', '.join(sorted(unknown))}; there are {', '.join(Skip.model_fields)}")
    try:
        folder = find_capture(args.capture, args.out) if args.capture == BUILT_IN else Path(args.capture).resolve()
    except UsageError as error:
        parser.error(str(error))
    out = args.out / "runs" / folder.name
    try:
        if args.reuse:
            reuse(args.reuse, out)
    except UsageError as error:
        parser.error(str(error))
    rows: list[Row] = []
    for rule, mode in [("", "auto"), *((rule, mode) for rule in args.rules for mode in args.modes)]:
        rows.append(measure_run(folder, args.profile, rule, mode, out, args.threads))
        show(rows[-1])
        write(args.csv, rows)


if __name__ == "__main__":
    main()
