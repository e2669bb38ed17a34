"""Ablation of the material fit's rules over many objects: the bake of finished runs once more without each of them, scored.

python -m benchmarks.ablation RUNS CAPTURES OUT [--only brass_vase,toy] [--rules metal-trials,emission] [--seed 0] [--views 0]
    [--scorer DIR] [--csv FILE]

RUNS has a folder of a finished run (`--profile relight`) per object, CAPTURES the capture of the same name with its reference in `gt/`;
`benchmarks.objects` makes both. Mesh, poses and photos are those of the run. The first row of an object has all rules, then one is taken
out at a time (`RULES`): a pass of the recipe (`gsbake.materials.recipe`) or a setting. Seconds are those of the bake; set
OMP_WAIT_POLICY=PASSIVE where other work runs beside it. `--views` scores on that many of the reference's views, evenly chosen, instead of
all. Rows have commit, host and seed, and replace those of the same object, rule, seed and commit in the CSV file. The table at the end has,
for each rule, what it brings on the objects whose figures it changes: the mean, and the worst object.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchmarks.ceiling import finished_folders
from benchmarks.csv_rows import current_commit, read_rows, today, write_rows
from benchmarks.materials import truth_subset
from benchmarks.objects.__main__ import FIGURES, PYTHON, SCORER, score
from benchmarks.timeline import ROOT
from gsbake.config.load import load_profile
from gsbake.errors import GsbakeError
from gsbake.gltf.export import ExportOptions, export_asset
from gsbake.materials.bake import BakeOptions, bake_textures
from gsbake.materials.recipe import OPTIONAL
from gsbake.system.limits import cpu_name

RESULTS = ROOT / "benchmarks" / "results" / "ablation.csv"

#: Rules that are settings, with the values that take them out.
SETTINGS = {"sparsity": "bake.sparsity=0", "neutral-light": "bake.neutral_light=0", "smoothness": "bake.smoothness=0"}
#: All that can be taken out: passes of the recipe, and settings.
RULES = ("none", *OPTIONAL, *SETTINGS)


@dataclass(frozen=True)
class Row:
    """One bake without a `rule` ("none": with all), scored: as the rows of `benchmarks.objects`."""

    object: str
    rule: str
    seed: int
    commit: str
    host: str
    seconds: float
    relit: float
    relit_scaled: float
    base: float
    base_scaled: float
    roughness: float
    metallic: float
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one key replace each other."""
        return self.object, self.rule, str(self.seed), self.commit


def bake_without(rule: str, run: Path, out: Path, seed: int) -> float:
    """Write the asset of the finished `run` with textures baked without a rule to `out`; returns the seconds of the bake.

    Raises UsageError when the run is not finished.
    """
    folder = finished_folders(run)
    manifest = json.loads((folder["bake"] / "manifest.json").read_text(encoding="utf-8"))
    overrides = [f"{key}={value}" for key, value in manifest["settings"].items()]
    profile = load_profile("relight", [*overrides, *([SETTINGS[rule]] if rule in SETTINGS else [])]).profile
    baked = out / "baked"
    shutil.rmtree(baked, ignore_errors=True)  # of a run that was stopped
    baked.mkdir(parents=True)
    begun = time.perf_counter()
    options = replace(BakeOptions.of(profile), without=frozenset({rule} & set(OPTIONAL)))
    bake_textures(folder["ingest"], folder["poses"], folder["refine"], folder["mesh"], baked, options, seed=seed)
    seconds = time.perf_counter() - begun
    export_asset(folder["ingest"], folder["poses"], folder["refine"], baked, out, ExportOptions(materials="fit"))
    return seconds


def markdown(rows: Sequence[Row]) -> str:
    """For each rule its mean gain on the objects whose figures it changes, the worst object, and the seconds that it takes."""
    whole = {row.object: row for row in rows if row.rule == "none"}
    lines = ["| rule | objects | relit dB (scaled) | worst | base colour dB (scaled) | worst | metallic | seconds |", "|---" * 8 + "|"]
    for rule in dict.fromkeys(row.rule for row in rows if row.rule != "none"):
        pairs = [(whole[row.object], row) for row in rows if row.rule == rule and row.object in whole]
        changed = [(a, b) for a, b in pairs if (a.relit, a.base, a.metallic) != (b.relit, b.base, b.metallic)]
        if not changed:
            lines.append(f"| {rule} | 0 of {len(pairs)} |" + " – |" * 6)
            continue

        def mean(name: str, changed: Sequence[tuple[Row, Row]] = changed) -> float:
            return statistics.mean(getattr(a, name) - getattr(b, name) for a, b in changed)

        cells = [rule, f"{len(changed)} of {len(pairs)}"]
        for name in ("relit", "base"):
            worst, where = min((getattr(a, name) - getattr(b, name), a.object) for a, b in changed)
            cells += [f"{mean(name):+.1f} ({mean(name + '_scaled'):+.1f})", f"{worst:+.1f} {where}"]
        lines.append("| " + " | ".join([*cells, f"{mean('metallic'):+.3f}", f"{mean('seconds'):+.0f}"]) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Bake, score, write the rows and print the table; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("runs", "captures", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--only", type=lambda text: text.split(","), metavar="NAME,…", help="all finished runs by default")
    parser.add_argument("--rules", type=lambda text: text.split(","), default=list(RULES), metavar="RULE,…", help="all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=0, help="0: all")
    parser.add_argument("--scorer", type=Path, default=SCORER)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.rules) - set(RULES)):
        parser.error(f"there is no rule {unknown[0]}; there are {', '.join(RULES)}")
    if not PYTHON.is_file() or not (options.scorer / "score.py").is_file():
        parser.error(f"the scorer is not installed: run `make score` once (its folder: {options.scorer})")
    names = options.only or sorted(path.parent.name for path in options.runs.glob("*/asset.glb"))
    commit, failed = current_commit(), 0
    for name in names:
        subset, capture = options.out / "truth" / name / "gt", options.captures / name
        shutil.rmtree(subset, ignore_errors=True)
        scored = truth_subset(capture / "gt", options.views, subset).parent
        for rule in dict.fromkeys(["none", *options.rules]):
            out = options.out / rule / name
            try:
                seconds = bake_without(rule, options.runs / name, out, options.seed)
                cameras = None if (capture / "transforms.json").is_file() else out / "cameras.json"
                found = score(scored, out / "asset.glb", cameras, options.scorer)
            except (GsbakeError, subprocess.CalledProcessError) as error:
                print(f"{name} without {rule}: {error}", file=sys.stderr)
                failed += 1
                continue
            figures = {column: round(float(found[key]), 4) for column, key in FIGURES.items() if column in Row.__dataclass_fields__}
            row = Row(name, rule, options.seed, commit, cpu_name(), round(seconds, 1), **figures)
            write_rows(options.csv, [*read_rows(options.csv, Row), row])
            print(row, flush=True)
    print(markdown([row for row in read_rows(options.csv, Row) if row.commit == commit and row.seed == options.seed]))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
