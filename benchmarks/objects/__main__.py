"""Table of objects with known materials: each is rendered with Cycles, baked from its photos, and scored.

python -m benchmarks.objects OUT [--only brass_vase,toy] [--profile relight] [--seed 0] [--set section.key=value ...] [--scorer DIR]
    [--csv FILE]

Renders lie in OUT/captures and are made once (about 7 minutes an object on two cores); bakes in OUT/runs/COMMIT, so that a second table of
the same commit only scores. `--scorer` is the folder of the independent scorer (default ../shared/score); `make score` installs its
environment. Rows replace those of the same object, profile, seed, overrides and commit in the CSV file; the table ends with medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.ceiling_rows import TRUE, beside, beside_pair, ceilings
from benchmarks.ceiling_rows import Row as Ceiling
from benchmarks.csv_rows import current_commit, read_rows, today, write_rows
from benchmarks.objects.entries import Entry, read_entries
from benchmarks.timeline import ROOT
from gsbake.errors import GsbakeError
from gsbake.system.limits import cpu_name

RESULTS = ROOT / "benchmarks" / "results" / "objects.csv"
#: The scorer's folder and interpreter, where `make score` has them.
SCORER, PYTHON = ROOT.parent / "shared" / "score", ROOT / ".score" / "bin" / "python"
#: Figures of the scorer's JSON by column.
FIGURES = {
    "chamfer_pct": "chamfer_pct", "normal_deg": "normal_deg", "relit": "relight_psnr", "relit_scaled": "relight_psnr_scaled",
    "base": "albedo_psnr", "base_scaled": "albedo_psnr_scaled", "roughness": "roughness_rmse", "metallic": "metallic_rmse",
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One object baked and scored: seconds of the whole run; Chamfer distance in % of the diagonal, normals in degrees; PSNR in dB under
    other lights and of base colour, without and with one scale; root mean squares of roughness and metallic; gains of base colour."""

    object: str
    metal: str
    profile: str
    settings: str
    seed: int
    commit: str
    host: str
    seconds: float
    chamfer_pct: float
    normal_deg: float | None
    relit: float
    relit_scaled: float
    base: float
    base_scaled: float
    roughness: float
    metallic: float
    gains: str
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one key replace each other."""
        return self.object, self.profile, self.settings, str(self.seed), self.commit


def row_of(entry: Entry, arguments: argparse.Namespace, commit: str, seconds: float, score: dict[str, Any]) -> Row:
    """The row of an object from the scorer's JSON."""
    gains = " ".join(f"{gain:.2f}" for gain in score["albedo_gain"])
    figures = {column: round(float(score[name]), 4) for column, name in FIGURES.items()}
    run = arguments.profile, " ".join(sorted(arguments.settings)), arguments.seed, commit, cpu_name(), round(seconds, 1)
    return Row(entry.name, entry.metal, *run, **figures, gains=gains)


def markdown(rows: Sequence[Row]) -> str:
    """A table of the rows, beside their ceilings where `benchmarks.ceiling` measured the mesh, with medians as the last line."""
    lines = ["| object | metal | s | Chamfer % | normal ° | relit (scaled) dB | base colour (scaled) dB | roughness | metallic | gains |"]
    lines.append("|---" * 10 + "|")
    for row in rows:
        lines.append(_line(row.object, row.metal, row.gains, partial(getattr, row), ceilings(row.object, row.chamfer_pct).get(TRUE)))
    if len(rows) > 1:
        lines.append(_line("**median**", "", "", lambda name: statistics.median(getattr(row, name) for row in rows)))
    return "\n".join(lines) + "\n"


def _line(name: str, metal: str, gains: str, figure: Callable[[str], float], ceiling: Ceiling | None = None) -> str:
    relit, base = (beside_pair(figure, ceiling, column) for column in ("relit", "base"))
    roughness, metallic = (beside(figure(column), ceiling, column, 3) for column in ("roughness", "metallic"))
    seconds, chamfer, normal = (format(figure(k), form) for k, form in (("seconds", ".0f"), ("chamfer_pct", ".3f"), ("normal_deg", ".1f")))
    return f"| {' | '.join([name, metal, seconds, chamfer, normal, relit, base, roughness, metallic, gains])} |"


def render(entry: Entry, out: Path, shared: Path) -> Path:
    """The capture of an object, rendered unless it is there. Raises CalledProcessError when Blender fails."""
    capture, done = out / "captures" / entry.name, out / "captures" / entry.name / "rendered.txt"
    if done.is_file() and done.read_text() == entry.key:
        return capture
    capture.mkdir(parents=True, exist_ok=True)
    model = out / "captures" / f"{entry.name}.glb"
    model.write_bytes(entry.model_bytes(shared))
    command = entry.render_command(PYTHON, model, capture, shared / "score", lights())
    with (out / "captures" / f"{entry.name}.log").open("w") as log:
        subprocess.run(command, check=True, stdout=log, stderr=subprocess.STDOUT)
    done.write_text(entry.key)
    return capture


def lights() -> Path:
    """The folder of the environments that Blender's Python module brings."""
    code = "import bpy, pathlib; print(pathlib.Path(bpy.utils.resource_path('LOCAL')) / 'datafiles/studiolights/world')"
    return Path(subprocess.run([str(PYTHON), "-c", code], check=True, capture_output=True, text=True).stdout.strip().splitlines()[-1])


def bake(capture: Path, out: Path, arguments: argparse.Namespace) -> float:
    """Bake a capture with the command line of this tree; seconds of the run, as remembered from the first one."""
    remembered = out / "seconds.txt"
    if not (out / "asset.glb").is_file() or not remembered.is_file():
        command = [sys.executable, "-m", "gsbake", "run", str(capture), "--out", str(out), "--profile", arguments.profile]
        command += ["--seed", str(arguments.seed)] + [part for setting in arguments.settings for part in ("--set", setting)]
        start = time.perf_counter()
        with (out.parent / f"{out.name}.log").open("w") as log:
            subprocess.run(command, check=True, stdout=log, stderr=subprocess.STDOUT)
        remembered.write_text(f"{time.perf_counter() - start:.1f}")
    return float(remembered.read_text())


def score(capture: Path, asset: Path, cameras: Path | None, scorer: Path) -> dict[str, Any]:
    """The scorer's JSON."""
    command = [str(PYTHON), str(scorer / "score.py"), str(capture / "gt"), str(asset)]
    command += ["--cameras", str(cameras)] if cameras else []
    found = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return dict(json.loads(found[found.index("{") :]))


def main() -> None:
    """Render, bake and score, write the rows and print the table."""
    entries = read_entries()
    parser = argparse.ArgumentParser(description="Render, bake and score objects with known materials.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", type=lambda text: text.split(","), default=list(entries), metavar="NAME,…", help="all by default")
    parser.add_argument("--profile", default="relight")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--scorer", type=Path, default=SCORER)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if unknown := sorted(set(arguments.only) - set(entries)):
        parser.error(f"there is no object {unknown[0]}; there are {', '.join(entries)}")
    if not PYTHON.is_file() or not (arguments.scorer / "score.py").is_file():
        parser.error(f"the scorer is not installed: run `make score` once (its folder: {arguments.scorer})")
    commit, rows = current_commit(), []
    for name in arguments.only:
        entry = entries[name]
        run = arguments.out / "runs" / "-".join([commit, arguments.profile, str(arguments.seed), *sorted(arguments.settings)]) / name
        run.mkdir(parents=True, exist_ok=True)
        try:
            capture = render(entry, arguments.out, arguments.scorer.parent)
            seconds = bake(capture, run, arguments)
            found = score(capture, run / "asset.glb", None if entry.mode == "posed" else run / "cameras.json", arguments.scorer)
        except (GsbakeError, subprocess.CalledProcessError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        rows.append(row_of(entry, arguments, commit, seconds, found))
        write_rows(arguments.csv, [*read_rows(arguments.csv, Row), rows[-1]])
        print(markdown(rows[-1:]), flush=True)
    if not rows:
        sys.exit(1)
    print(markdown(rows))


if __name__ == "__main__":
    main()
