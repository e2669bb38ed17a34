"""Every field system on captures with known truth: error of the mesh, held-out PSNR, time and memory in one table.

python -m benchmarks.fields [--captures boombox,avocado,boombox:8] [--systems default,dsdf,gs-ror2] [--seeds 0] [--out DIR] [--csv FILE]
    [--set key=value …]

A system is a profile of its own; `default` is `relight`. All take the sizes and numbers of iterations of the profile `preview`, whose early
stages they share, and run up to the mesh. `NAME:8` is a capture with 8 of its photos, evenly chosen, poses given. Captures are in
$GSBAKE_CAPTURES, a list of folders separated by colons (default: ../shared/captures), or `built-in` for that of `gsbake synth`.

PSNR is that of the surfels on test photos, which no decision looks at. Seconds are wall time from the photos to the mesh as the manifests
have it; CPU seconds those of the stages' processes. MB are the peak memory. Rows carry commit, host and seed; a row replaces an older one
of the same capture, system, settings and seed. A system that fails is a row with the reason.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import shutil
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.csv_rows import current_commit, today
from benchmarks.skip import CpuClock
from benchmarks.timeline import BUILT_IN, CAPTURES, ROOT, manifests, names
from benchmarks.truth import measure_stage, read_truth
from gsbake.api import RunOptions, open_session
from gsbake.capture.photos.roles import test_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.load import shipped
from gsbake.config.schema import Profile
from gsbake.errors import BadInputError, UsageError
from gsbake.imaging.metrics import decibels
from gsbake.surfels.renderer import SurfelRenderer

RESULTS = ROOT / "benchmarks" / "results" / "fields.csv"
#: Profiles of the family, `default` first.
SYSTEMS = (
    "default", "dsdf", "gs-ror2", "3dgsr", "gsdf", "gs-octree", "gs-pull", "surfacesplat", "splatsdf", "gaussianroom", "ugsdf", "sdf-3dgan",
    "neus", "volsdf",
)  # fmt: skip
DEFAULT_CAPTURES = ("boombox", "avocado", "brass_vase", "mixer", "stool", "boombox:8")
#: Columns that say what a row measures.
KEY = ("capture", "system", "settings", "seed")
#: Sections of the profile `preview` whose values every system takes.
SIZES = ("ingest", "stereo", "surfels", "train", "refine", "mesh")


@dataclass(frozen=True)
class Row:
    """One mesh; None where there is no such figure, with the reason in `failed`."""

    capture: str
    system: str
    settings: str
    seed: int
    chamfer_pct: float | None = None
    fscore: float | None = None
    normal_deg: float | None = None
    test_psnr: float | None = None
    seconds: float | None = None
    cpu_s: float | None = None
    peak_mb: float | None = None
    surfels: int | None = None
    failed: str = ""
    commit: str = ""
    host: str = ""
    date: str = field(default_factory=today)


def sizes() -> list[str]:
    """The values of `preview` as overrides."""
    body = tomllib.loads(shipped()["preview"].read_text())
    values = [(section, key, value) for section in SIZES for key, value in body.get(section, {}).items()]
    return [f"{section}.{key}={value}" for section, key, value in values if key != "shading"]


def find(name: str, out: Path) -> tuple[Path, Path]:
    """Folders of the photos and of the truth of a capture; the one of few photos is made where missing. Raises UsageError without it."""
    base, _, count = name.partition(":")
    if base == BUILT_IN:
        truth = out / "built-in-capture"
        if not (truth / "truth" / "mesh.ply").is_file():
            from gsbake.synth.capture import write_capture

            write_capture(truth)
    else:
        roots = [Path(root) for root in os.environ.get("GSBAKE_CAPTURES", str(CAPTURES)).split(os.pathsep)]
        truth = next((root / base for root in roots if (root / base).is_dir()), roots[0] / base)
    if not truth.is_dir():
        raise UsageError(f"{truth} does not exist; set GSBAKE_CAPTURES to the folders of the captures.")
    read_truth(truth)
    return (few_photos(truth, int(count), out / "few" / f"{base}-{count}") if count else truth), truth


def few_photos(capture: Path, count: int, folder: Path) -> Path:
    """A capture with `count` photos of `capture`, evenly chosen in its `transforms.json`, in `folder`."""
    if not (capture / "transforms.json").is_file():
        raise UsageError(f"{capture} has no transforms.json; few photos need given poses.")
    body = json.loads((capture / "transforms.json").read_text())
    frames = body["frames"]
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))]
    for frame in chosen:
        source = capture / frame["file_path"]
        source = source if source.is_file() else source.with_suffix(".png")
        target = folder / "images" / source.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.is_file():
            shutil.copyfile(source, target)
    (folder / "transforms.json").write_text(json.dumps(body | {"frames": chosen}, indent=1))
    return folder


def measured_psnr(poses: Path, refined: Path, holdout: int, size: int) -> float | None:
    """PSNR in dB of the surfels on the test photos inside the masks (all pixels without); None where there are no test photos."""
    posed, renderer = PosedPhotos.open(poses, refined), SurfelRenderer.load(refined)
    figures = []
    for index in test_photos(len(posed), holdout):
        view = posed.view(index, size)
        picture, alpha = renderer.photo(view.camera)
        inside = alpha > 0.5 if view.mask is None else view.mask > 127
        error = (picture / np.maximum(alpha, 1e-3)[..., None] - view.rgb / 255.0) ** 2
        figures.append(decibels(float(error[inside].mean())))
    return float(np.mean(figures)) if figures else None


def run_options(capture: str, system: str, seed: int, settings: Sequence[str], out: Path, threads: int) -> tuple[RunOptions, Path]:
    """The run of one system on one capture, and the folder of the truth. Raises UsageError as `find`."""
    photos, truth = find(capture, out)
    profile, folder = "relight" if system == "default" else system, out / "runs" / capture.replace(":", "-")
    return RunOptions(
        photos=photos, out=folder, profile=profile, overrides=[*sizes(), *settings], device="cpu", threads=threads, seed=seed
    ), truth  # fmt: skip


def measure(capture: str, system: str, seed: int, settings: Sequence[str], out: Path, threads: int) -> Row:
    """Run one system on one capture up to the mesh (or use cached stages), and measure it."""
    row = Row(capture, system, " ".join(settings), seed, commit=current_commit(), host=platform.node())
    options, truth = run_options(capture, system, seed, settings, out, threads)
    clock = CpuClock(options.out / "cpu.json")
    try:
        session = open_session(options, clock)
        states = session.engine.run("mesh")
    except BadInputError as error:
        return replace(row, failed=str(error))
    done = manifests(states)
    at = {s.name: s.artifact.folder for s in states if s.artifact is not None}
    figures = measure_stage(at["mesh"] / "mesh.ply", at["poses"], truth)
    p: Profile = session.profile.profile
    return replace(
        row,
        chamfer_pct=figures.chamfer_pct,
        fscore=figures.fscore,
        normal_deg=figures.normal_deg,
        test_psnr=measured_psnr(at["poses"], at["refine"], p.train.holdout, p.train.max_size),
        seconds=sum(m["seconds"] for m in done.values()),
        cpu_s=clock.total(states),
        peak_mb=max(m["peak_bytes"] for m in done.values()) / 1e6,
        surfels=done["refine"]["results"]["surfels"],
    )


def write(path: Path, rows: Sequence[Any], key: Sequence[str]) -> None:
    """Add rows, dataclasses of one kind, in the place of those with the same values in the columns `key`."""
    new = [{k: "" if v is None else round(v, 4) if isinstance(v, float) else v for k, v in asdict(row).items()} for row in rows]
    known = {tuple(str(line[k]) for k in key) for line in new}
    old: list[dict[str, Any]] = []
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            old = [line for line in csv.DictReader(file) if tuple(line[k] for k in key) not in known]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(rows[0])], lineterminator="\n")
        writer.writeheader()
        writer.writerows([*old, *new])


def show(row: Row) -> None:
    """Print a row."""

    def text(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    shape = f"Chamfer {text(row.chamfer_pct, '.4f')} %  F {text(row.fscore, '.4f')}  normals {text(row.normal_deg, '.2f')}°"
    cost = f"{text(row.seconds, '.0f')} s  CPU {text(row.cpu_s, '.0f')} s  {text(row.peak_mb, '.0f')} MB  {row.failed}"
    name = f"{row.capture:12} {row.system:14} {row.settings} seed {row.seed}"
    sys.stdout.write(f"{name}  {shape}  PSNR {text(row.test_psnr, '.2f')} dB  {cost}\n")
    sys.stdout.flush()


def parse(
    arguments: Sequence[str] | None, description: str | None, captures: Sequence[str], systems: Sequence[str], results: Path
) -> argparse.Namespace:
    """The arguments of a benchmark of field systems, with its defaults."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=names, default=list(captures))
    parser.add_argument("--systems", type=names, default=list(systems))
    parser.add_argument("--seeds", type=lambda text: [int(v) for v in text.split(",")], default=[0])
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE", help="a setting of all systems")
    parser.add_argument("--threads", type=int, default=0, help="0: the physical cores")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "fields", help="folder of the runs; finished stages are kept")
    parser.add_argument("--csv", type=Path, default=results)
    args = parser.parse_args(arguments)
    if unknown := set(args.systems) - set(SYSTEMS):
        parser.error(f"there is no system {', '.join(sorted(unknown))}; there are {', '.join(SYSTEMS)}")
    return args


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, print every row, and write the CSV after each."""
    args = parse(arguments, __doc__, DEFAULT_CAPTURES, SYSTEMS, RESULTS)
    for capture in args.captures:
        for system in args.systems:
            for seed in args.seeds:
                try:
                    row = measure(capture, system, seed, args.settings, args.out.resolve(), args.threads)
                except UsageError as error:
                    sys.stdout.write(f"{capture}: left out: {error}\n")
                    break
                show(row)
                write(args.csv, [row], KEY)


if __name__ == "__main__":
    main()
