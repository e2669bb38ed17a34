"""Error against time: error of the mesh over seconds, by capture, profile and initialisation of the surfels.

python -m benchmarks.timeline [--captures boombox,avocado] [--profiles preview,relight] [--starts stereo,hull,points,sphere]
    [--shares 0,0.05,0.15,0.5,1] [--no-peers] [--threads 2]

A checkpoint is a separate bake up to the mesh with a share of the profile's training and refinement iterations, because the schedules scale
with them. Checkpoints share common stages (ingest, poses, stereo), whose recorded seconds count in each. Initialisations other than stereo
skip the stereo stage (`stereo.enabled = never`) with its seconds and depths. An initialisation that is not available (no masks, too few
points) is skipped with a message.

Captures with ground truth are in $GSBAKE_CAPTURES, else in ../shared/captures; `built-in` is that of `gsbake synth`. Other tools run where
they are installed (`benchmarks.peers`); figures of published tables are marked as quoted. Writes
benchmarks/results/timeline.csv and docs/lab/error-time-<capture>.svg, and prints the Pareto front. Finished checkpoints
in --out are reused.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import peers
from benchmarks.rows import INIT_COLOURS, Row, draw, markdown, merged, read_csv, text, write_csv
from benchmarks.truth import measure_stage, read_truth
from gsbake.api import RunOptions, Session, open_session
from gsbake.config.load import load_profile
from gsbake.errors import BadInputError, UsageError
from gsbake.pipeline.plan import StageState

ROOT = Path(__file__).resolve().parents[1]
CAPTURES = Path(os.environ.get("GSBAKE_CAPTURES", ROOT.parent / "shared" / "captures"))
RESULTS = ROOT / "benchmarks" / "results" / "timeline.csv"
CHARTS = ROOT / "docs" / "lab"
BUILT_IN = "built-in"


@dataclass(frozen=True)
class Checkpoint:
    """One bake up to the mesh: capture, profile, initialisation (`start`), and the share of the profile's iterations."""

    capture: str
    folder: Path
    profile: str
    start: str
    share: float

    def open(self, out: Path, threads: int) -> Session:
        """Session of the bake, in the output folder of its capture."""
        settings = load_profile(self.profile).profile
        overrides = [
            f"train.iterations={round(self.share * settings.train.iterations)}",
            f"refine.iterations={round(self.share * settings.refine.iterations)}",
            f"train.init={self.start}",
            f"stereo.enabled={'auto' if self.start == 'stereo' else 'never'}",
        ]
        options = RunOptions(
            photos=self.folder, out=out / self.capture, profile=self.profile, overrides=overrides, device="cpu", threads=threads
        )
        return open_session(options)


def find_capture(name: str, out: Path) -> Path:
    """Folder of a capture; the built-in one is created if missing. Raises UsageError without the capture or its ground truth."""
    folder = CAPTURES / name
    if name == BUILT_IN:
        folder = out / "built-in-capture"
        if not (folder / "truth" / "mesh.ply").is_file():
            from gsbake.synth.capture import write_capture

            write_capture(folder)
    elif not folder.is_dir():
        raise UsageError(f"{folder} does not exist; set GSBAKE_CAPTURES to the folder of the captures.")
    read_truth(folder)
    return folder


def manifests(states: Sequence[StageState]) -> dict[str, dict[str, Any]]:
    """{stage: manifest} of the finished stages."""
    return {s.name: dict(s.artifact.manifest) for s in states if s.artifact is not None}


def run_checkpoint(point: Checkpoint, out: Path, threads: int) -> Row:
    """Bake up to the mesh (or use cached stages) and measure it; a row without figures when meshing failed.

    Raises UsageError when the initialisation is not available, or training failed.
    """
    engine = point.open(out, threads).engine
    try:
        states = engine.run("mesh")
    except BadInputError as error:
        states = engine.plan("mesh")
        if states[-2].artifact is None:  # a stage before the mesh failed
            raise UsageError(str(error)) from error
    folders = {s.name: s.artifact.folder for s in states if s.artifact is not None}
    done = manifests(states)
    chosen = next(d for d in done["train"]["decisions"] if d["what"] == "initialisation")
    if chosen["choice"] != point.start:
        raise UsageError(f"the initialisation was {chosen['choice']} ({chosen['evidence']}).")
    row = Row(
        capture=point.capture,
        tool="gsbake",
        profile=point.profile,
        start=point.start,
        steps=done["train"]["results"]["steps"] + done["refine"]["results"]["steps"],
        seconds=sum(m["seconds"] for m in done.values()),
        psnr=done["refine"]["results"]["psnr"],
        peak_mb=max(m["peak_bytes"] for m in done.values()) / 1e6,
    )
    if "mesh" not in folders:
        return row
    return row.with_figures(measure_stage(folders["mesh"] / "mesh.ply", folders["poses"], point.folder))


def run_series(capture: str, folder: Path, profile: str, start: str, shares: Sequence[float], out: Path, threads: int) -> list[Row]:
    """Checkpoints of one curve; none, with a message, when the initialisation is not available."""
    rows: list[Row] = []
    for share in shares:
        try:
            row = run_checkpoint(Checkpoint(capture, folder, profile, start, share), out, threads)
        except UsageError as error:
            sys.stdout.write(f"{capture}, {profile}, from {start}: skipped; {error}\n")
            return []
        rows.append(row)
        report(row)
    return rows


def report(row: Row) -> None:
    """Print a finished row."""
    figures = f"Chamfer {text(row.chamfer_pct, '.3f')} %  F {text(row.fscore, '.3f')}  normal {text(row.normal_deg, '.1f')}°"
    spent = f"{text(row.steps, 'd'):>6} steps {row.seconds:8.1f} s"
    sys.stdout.write(f"{row.capture:10} {row.name:32} {spent}  {figures}  PSNR {text(row.psnr, '.2f')} dB\n")
    sys.stdout.flush()


def run_peers(name: str, folder: Path, out: Path, threads: int) -> list[Row]:
    """Rows of other tools: measured where they are installed, and quoted ones."""
    rows = [row for row in peers.QUOTED if row.capture == name]
    rows += peers.run_pyarchinit(name, folder, out / name / "pyarchinit")
    if peers.has_openmvs():
        point = Checkpoint(name, folder, "relight", "stereo", 0.0)
        states = point.open(out, threads).engine.run("poses")
        shared = {s.name: s.artifact.folder for s in states if s.artifact is not None}
        spent = sum(m["seconds"] for m in manifests(states).values())
        rows += peers.run_openmvs(name, folder, shared, spent, out / name / "openmvs", threads)
    for row in rows:
        report(row)
    return rows


def numbers(text: str) -> list[float]:
    """Parse comma-separated shares."""
    return [float(v) for v in text.split(",")]


def names(text: str) -> list[str]:
    """Parse comma-separated names."""
    return [v for v in text.split(",") if v]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print every row, write CSV and charts, and print the Pareto front."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=names, default=["boombox", "avocado"])
    parser.add_argument("--profiles", type=names, default=["preview", "relight"])
    parser.add_argument("--starts", type=names, default=list(INIT_COLOURS))
    parser.add_argument("--shares", type=numbers, default=[0.0, 0.05, 0.15, 0.5, 1.0])
    parser.add_argument("--no-peers", action="store_true", help="skip the other tools")
    parser.add_argument("--threads", type=int, default=0, help="0: the physical cores")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "timeline", help="folder of the checkpoints")
    parser.add_argument("--csv", type=Path, default=RESULTS)
    parser.add_argument("--charts", type=Path, default=CHARTS, help="folder of the charts")
    args = parser.parse_args(arguments)
    rows = read_csv(args.csv)

    def keep(new: Sequence[Row]) -> None:
        nonlocal rows
        rows = merged(rows, new)
        write_csv(args.csv, rows)

    for name in args.captures:
        try:
            folder = find_capture(name, args.out)
        except UsageError as error:
            sys.stdout.write(f"{name}: skipped; {error}\n")
            continue
        for profile in args.profiles:
            for start in args.starts:
                keep(run_series(name, folder, profile, start, args.shares, args.out, args.threads))
        if not args.no_peers:
            keep(run_peers(name, folder, args.out, args.threads))
        if chosen := [row for row in rows if row.capture == name]:
            draw(args.charts / f"error-time-{name}.svg", name, chosen)
    sys.stdout.write("\n" + markdown(rows))


if __name__ == "__main__":
    main()
