"""The table of the README: captures with known shape and material, baked with the profiles for assets and scored.

python -m benchmarks.headline OUT [--captures DIR] [--only boombox:relight] [--scorer DIR]

Each capture is baked with `gsbake run CAPTURE --profile PROFILE` into OUT and scored by the independent scorer, whose environment
`make score` installs. Minutes are those of the whole command on a machine that does nothing else, kernels compiled before. The rows of
other programs are quoted from the scorer's README, not measured here.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.csv_rows import current_commit, read_rows, today, write_rows
from benchmarks.objects.__main__ import FIGURES, SCORER, bake, score
from benchmarks.timeline import ROOT
from gsbake.system.limits import cpu_name

RESULTS = ROOT / "benchmarks" / "results" / "headline.csv"
#: Captures and profiles of the table; poses of the second capture are solved.
ROWS = (("boombox", "preview"), ("boombox", "relight"), ("avocado", "preview"), ("avocado", "relight"))


@dataclass(frozen=True)
class Row:
    """One asset: seconds and peak memory of its run; Chamfer distance in % of the diagonal, normals in degrees; PSNR in dB under other
    lights and of base colour, with a gain per channel. `source` is "measured" or "quoted"."""

    capture: str
    made_by: str
    seconds: float | None
    peak_mb: float | None
    chamfer_pct: float | None
    normal_deg: float | None
    relit_scaled: float | None
    base_scaled: float | None
    source: str
    processors: str
    commit: str
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one key replace each other."""
        return self.capture, self.made_by


def measure(capture: Path, profile: str, out: Path, scorer: Path) -> Row:
    """Bake and score one capture."""
    seconds = bake(capture, out, argparse.Namespace(profile=profile, seed=0, settings=[]))
    stages = [json.loads(path.read_text(encoding="utf-8")) for path in out.glob("stages/*/*/manifest.json")]
    solved = json.loads(next(out.glob("stages/poses/*/cameras.json")).read_text(encoding="utf-8"))["poses"] != "given"
    found = score(capture, out / "asset.glb", out / "cameras.json" if solved else None, scorer)
    columns = ("chamfer_pct", "normal_deg", *(("relit_scaled", "base_scaled") if profile == "relight" else ()))
    figures = {column: round(float(found[FIGURES[column]]), 4) for column in columns}
    figures = dict.fromkeys(("relit_scaled", "base_scaled")) | figures
    peak = max(stage["peak_bytes"] for stage in stages) / 1e6
    processors = f"{psutil.cpu_count()} x {cpu_name()}"
    return Row(
        capture.name, profile, seconds, round(peak, 1), source="measured", processors=processors, commit=current_commit(), **figures
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the rows one by one, and write each at once."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--captures", type=Path, default=ROOT.parent / "shared" / "captures")
    parser.add_argument("--only", action="append", metavar="CAPTURE:PROFILE", help="one row; may be given more than once")
    parser.add_argument("--scorer", type=Path, default=SCORER)
    options = parser.parse_args(arguments)
    for name, profile in ROWS:
        if options.only and f"{name}:{profile}" not in options.only:
            continue
        out = options.out / f"{name}-{profile}"
        out.parent.mkdir(parents=True, exist_ok=True)
        row = measure(options.captures / name, profile, out, options.scorer)
        write_rows(RESULTS, [*read_rows(RESULTS, Row), row])
        print(row)


if __name__ == "__main__":
    main()
