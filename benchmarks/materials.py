"""Ablation of the material fit: from projected surfel materials to the full fit in texture space.

python -m benchmarks.materials [CAPTURE ...] [--profile relight] [--reuse RUN ...] [--rows projected,fit] [--set section.key=value ...]
    [--scorer DIR] [--views 0] [--out DIR] [--csv FILE]

CAPTURE is a folder with its reference in `gt/`; default: boombox and avocado in $GSBAKE_CAPTURES, else ../shared/captures. The rows
(`ROW_SETTINGS`) are cumulative. Rows of the texture fit share one run up to the mesh; the first trains surfels with materials and has its
own mesh. `--reuse` takes the stages up to the mesh from a finished run of the same photos and profile, one per capture; RUN itself is only
read. `--set` applies to all rows.

`psnr` compares renders of the asset under the fitted light with the held-out photos, as the report does; `texel_…` compare its textures
with the reference (`benchmarks.maps`). The rest comes from the independent scorer, where it is installed (`make score` once, or
`--scorer`): relighting under other environments, base colour, roughness and metallic against the reference. `--views` scores on that many
of the reference's views, evenly chosen, instead of all. CPU seconds are those of the stages that make materials: the bake, and train and
refine where surfels carry materials.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from benchmarks.ceiling_rows import markdown as ceiling_table
from benchmarks.ceiling_rows import newest
from benchmarks.csv_rows import today
from benchmarks.maps import measure_maps
from benchmarks.skip import CpuClock, reuse, write
from benchmarks.timeline import CAPTURES, ROOT, manifests, names
from gsbake.api import RunOptions, open_session
from gsbake.errors import GsbakeError, UsageError

RESULTS = ROOT / "benchmarks" / "results" / "materials.csv"
#: The scorer's folder and interpreter, where `make score` has them.
SCORER, PYTHON = ROOT.parent / "shared" / "score", ROOT / ".score" / "bin" / "python"
#: Names of the stages up to the mesh.
TO_MESH = ("ingest", "poses", "stereo", "train", "refine", "mesh")
#: Overrides that turn all priors off.
NO_PRIORS = tuple(f"bake.{prior}=0" for prior in ("smoothness", "base_color_l1", "metallic_l1", "neutral_light", "sparsity"))
#: Overrides of each row.
ROW_SETTINGS: dict[str, tuple[str, ...]] = {
    "projected": ("surfels.shading=pbr", "bake.materials=surfels"),
    "fit": ("bake.materials=fit", "bake.visibility=none", *NO_PRIORS),
    "visibility": ("bake.materials=fit", "bake.visibility=directional", *NO_PRIORS),
    "bounce": ("bake.materials=fit", "bake.visibility=bounce", *NO_PRIORS),
    "reflections": ("bake.materials=fit", "bake.visibility=reflections", *NO_PRIORS),
    "priors": ("bake.materials=fit", "bake.visibility=reflections", "bake.sparsity=0"),
    "sparsity": ("bake.materials=fit", "bake.visibility=reflections"),
}


@dataclass(frozen=True)
class Row:
    """One asset: capture, profile, row, overrides for all rows, cost and errors; None where not measured."""

    capture: str
    profile: str
    row: str
    settings: str
    cpu_s: float
    psnr: float | None = None
    texel_albedo_psnr: float | None = None
    texel_roughness_rmse: float | None = None
    texel_metallic_rmse: float | None = None
    relight_psnr: float | None = None
    relight_psnr_scaled: float | None = None
    albedo_psnr_scaled: float | None = None
    roughness_rmse: float | None = None
    metallic_rmse: float | None = None
    date: str = field(default_factory=today)


def truth_subset(truth: Path, views: int, folder: Path) -> Path:
    """A copy of `truth` in `folder` with `views` of its views, evenly chosen; `truth` itself for 0."""
    if views == 0:
        return truth
    every: dict[str, Any] = json.loads((truth / "views.json").read_text())
    count = len(every["c2w"])
    chosen = [k * count // views for k in range(min(views, count))]
    shutil.copytree(truth, folder, ignore=shutil.ignore_patterns("ref", "views.json"))
    (folder / "views.json").write_text(json.dumps(every | {"c2w": [every["c2w"][k] for k in chosen]}))
    for light in (truth / "ref").iterdir():
        (folder / "ref" / light.name).mkdir(parents=True)
        for new, old in enumerate(chosen):
            shutil.copyfile(light / f"{old:03d}.png", folder / "ref" / light.name / f"{new:03d}.png")
    return folder


def score(asset: Path, solved: bool, truth: Path, scorer: Path, python: Path) -> dict[str, float]:
    """The scorer's figures of an asset, aligned with the reference by its cameras where these were `solved`; none without a scorer.

    Raises UsageError when the scorer fails.
    """
    if not (scorer / "score.py").is_file() or not python.is_file():
        sys.stderr.write(f"not scored: {scorer}/score.py or {python} is missing; `make score` installs it\n")
        return {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "score.json"
        cameras = ["--cameras", str(asset.with_name("cameras.json"))] if solved else []
        done = subprocess.run(
            [python, scorer / "score.py", truth, asset, *cameras, "--json", out], capture_output=True, text=True, check=False
        )  # fmt: skip
        if done.returncode:
            raise UsageError(f"{scorer}/score.py failed on {asset}: {done.stderr.strip().splitlines()[-1:]}")
        figures: dict[str, Any] = json.loads(out.read_text())
    wanted = {f.name for f in fields(Row)}
    return {k: float(v) for k, v in figures.items() if k in wanted}


def measure(folder: Path, profile: str, row: str, overrides: Sequence[str], out: Path, threads: int) -> tuple[Row, Path, bool]:
    """Make the asset of one row, cached where possible: its row without the scorer's figures, its GLB, and whether poses were solved."""
    clock = CpuClock(out / "cpu.json")
    options = RunOptions(photos=folder, out=out, profile=profile, overrides=[*ROW_SETTINGS[row], *overrides], device="cpu", threads=threads)
    states = open_session(options, clock).engine.run("report")
    done = manifests(states)
    folders = {s.name: s.artifact.folder for s in states if s.artifact is not None}
    own = ("train", "refine", "bake") if row == "projected" else ("bake",)
    spent = clock.total([s for s in states if s.name in own])
    solved = json.loads((folders["poses"] / "cameras.json").read_text())["poses"] != "given"
    maps = measure_maps(folders["bake"], folders["mesh"], folders["poses"], folder)
    made = Row(folder.name, profile, row, " ".join(overrides), spent, done["report"]["results"]["psnr"], **asdict(maps))
    return made, folders["export"] / "asset.glb", solved


def markdown(rows: Sequence[Row]) -> str:
    """The rows as a table."""

    def text(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    head = "| | | held out dB | texels: base colour dB | roughness rmse | metallic rmse | relit dB | scaled | base colour dB | CPU s |"
    lines = [head, "|---" * 10 + "|"]
    for r in rows:
        parts = " | ".join(text(v, ".3f") for v in (r.texel_roughness_rmse, r.texel_metallic_rmse))
        scored = " | ".join(text(v, ".1f") for v in (r.relight_psnr, r.relight_psnr_scaled, r.albedo_psnr_scaled))
        shown = f"{text(r.psnr, '.1f')} | {text(r.texel_albedo_psnr, '.1f')} | {parts} | {scored}"
        lines.append(f"| {r.capture} | {r.row} | {shown} | {r.cpu_s:.0f} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Make, score and write the rows, then print them as a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="*")
    parser.add_argument("--profile", default="relight")
    parser.add_argument("--reuse", type=Path, action="append", default=[], help="a finished run, one per capture and in their order")
    parser.add_argument("--rows", type=names, default=list(ROW_SETTINGS))
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="override for all rows")
    parser.add_argument("--scorer", type=Path, default=SCORER, help="folder of score.py")
    parser.add_argument("--scorer-python", type=Path, default=PYTHON, help="interpreter that has Blender's module")
    parser.add_argument("--views", type=int, default=0, help="reference views to score on; 0: all")
    parser.add_argument("--threads", type=int, default=0, help="0: number of physical cores")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "materials", help="where the runs are kept")
    parser.add_argument("--csv", type=Path, default=RESULTS)
    args = parser.parse_args(arguments)
    captures = args.captures or [CAPTURES / name for name in ("boombox", "avocado")]
    if unknown := set(args.rows) - set(ROW_SETTINGS):
        parser.error(f"there is no row {', '.join(sorted(unknown))}; rows: {', '.join(ROW_SETTINGS)}")
    if args.reuse and len(args.reuse) != len(captures):
        parser.error(f"{len(args.reuse)} finished runs for {len(captures)} captures; give one for each")
    rows: list[Row] = []
    try:
        for k, capture in enumerate(folder.resolve() for folder in captures):
            if not (capture / "gt" / "views.json").is_file():
                raise UsageError(f"{capture} has no truth to measure against (gt/views.json).")
            out = args.out / capture.name
            if args.reuse:
                reuse(args.reuse[k], out, TO_MESH)
            with tempfile.TemporaryDirectory() as folder:
                truth = truth_subset(capture / "gt", args.views, Path(folder) / "gt")
                for name in args.rows:
                    row, asset, solved = measure(capture, args.profile, name, args.overrides, out, args.threads)
                    rows.append(Row(**asdict(row) | score(asset, solved, truth, args.scorer, args.scorer_python)))
                    write(args.csv, rows, 3)
                    sys.stdout.write(markdown(rows[-1:]).splitlines()[-1] + "\n")
                    sys.stdout.flush()
    except GsbakeError as error:
        parser.error(str(error))
    sys.stdout.write("\n" + markdown(rows))
    if known := [row for capture in captures for row in newest(capture.name, views=args.views).values()]:
        sys.stdout.write("\nCeilings of `benchmarks.ceiling` on the newest mesh:\n" + ceiling_table(known))


if __name__ == "__main__":
    main()
