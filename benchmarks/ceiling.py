"""Ceilings of materials: finished runs with the true maps laid on their meshes, scored beside their own maps.

python -m benchmarks.ceiling OBJECTS [--only brass_vase,toy] [--views 0] [--scorer DIR] [--csv FILE]

OBJECTS is the folder of `benchmarks.objects`: captures/NAME has the reference in `gt/`, runs/RUN/NAME is a finished run with materials; of
several runs of an object the newest counts. Three assets of one mesh are scored: the run's own; with the base colour, roughness, metallic
and emission of the nearest point of the reference in every texel, under the run's normals; and with the reference's normals as well. What
the second lacks to a perfect score is due to the shape and its normals, what the third lacks to the shape, and the rest of the run's own
loss to its materials. Assets lie in OBJECTS/ceiling. Rows replace those of the same object, maps, views and commit in the CSV file.
`--views` scores on that many of the reference's views, evenly chosen, instead of all.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.ceiling_rows import OWN, RESULTS, TRUE, TRUE_NORMALS, Row, markdown
from benchmarks.csv_rows import current_commit, read_rows, write_rows
from benchmarks.maps import ReferencePoints
from benchmarks.materials import truth_subset
from benchmarks.objects.__main__ import FIGURES, PYTHON, SCORER, score
from gsbake.errors import GsbakeError, UsageError
from gsbake.gltf.export import ExportOptions, export_asset
from gsbake.imaging.exr import read_exr, write_exr
from gsbake.pipeline.store import Store
from gsbake.texturing.normal_map import DenseSamples, normal_map
from gsbake.texturing.texels import rasterise

STAGES = ("ingest", "poses", "refine", "mesh", "bake")


def finished_folders(run: Path) -> dict[str, Path]:
    """{stage: artifact folder} of `STAGES`. Raises UsageError when the run is not finished."""
    store = Store(run)
    known = {name: store.manifests(name) for name in STAGES}
    if missing := [name for name in STAGES if not known[name]]:
        raise UsageError(f"{run} has no finished stage {missing[0]}; run `gsbake run` to its end first.")
    return {name: found[0][0] for name, found in known.items()}


def finished_runs(objects: Path) -> dict[str, Path]:
    """{object: folder of its newest finished run} of those with a capture."""
    found = sorted(objects.glob("runs/*/*/asset.glb"), key=lambda path: path.stat().st_mtime)
    return {path.parent.name: path.parent for path in found if (objects / "captures" / path.parent.name / "gt" / "views.json").is_file()}


def lay_true_maps(run: Path, capture: Path, out: Path) -> dict[str, Path]:
    """{maps: asset} of `run` with the true maps of `capture`, written to `out`, without and with true normals.

    Raises UsageError when the run is not finished, or has no materials.
    """
    from safetensors.numpy import load_file

    folder = finished_folders(run)
    baked = out / "baked"
    shutil.rmtree(baked, ignore_errors=True)
    shutil.copytree(folder["bake"], baked)
    (baked / "emissive.exr").unlink(missing_ok=True)
    if not (baked / "light.safetensors").is_file():
        raise UsageError(f"{run} has no materials; run it with `--profile relight`.")
    unwrapped, orm = load_file(baked / "mesh.safetensors"), read_exr(baked / "orm.exr")
    texels = rasterise(unwrapped["uv"], unwrapped["faces"], len(orm))
    points = texels.interpolate(unwrapped["position"], unwrapped["faces"])
    reference = ReferencePoints.nearest_to(points, folder["mesh"], folder["poses"], capture)
    nearest = tuple(ndimage.distance_transform_edt(~texels.covered(), return_distances=False, return_indices=True))

    def padded(values: np.ndarray) -> np.ndarray:
        return np.asarray(texels.image(values)[nearest])

    values, emission = reference.values(), reference.emission()
    write_exr(baked / "base_color.exr", padded(values[:, :3]))
    write_exr(baked / "orm.exr", np.concatenate([orm[..., :1], padded(values[:, 3:])], 2))
    if emission is not None:
        write_exr(baked / "emissive.exr", padded(emission))
    smooth, tangent = (texels.interpolate(unwrapped[name], unwrapped["faces"]) for name in ("normal", "tangent"))
    samples = DenseSamples(np.ones(len(points), bool), points.astype(np.float64), reference.normals(), 0.0)
    made = {}
    for maps in (TRUE, TRUE_NORMALS):
        if maps == TRUE_NORMALS:
            write_exr(baked / "normal.exr", padded(normal_map(samples, smooth, tangent)))
        asset = out / maps / "asset.glb"
        asset.parent.mkdir(parents=True, exist_ok=True)
        export_asset(folder["ingest"], folder["poses"], folder["refine"], baked, asset.parent, ExportOptions(materials="fit"))
        made[maps] = asset
    return made


def measure(name: str, run: Path, objects: Path, views: int, scorer: Path) -> list[Row]:
    """The rows of an object: own maps, true maps, true maps with true normals."""
    out, capture = objects / "ceiling" / name, objects / "captures" / name
    assets = {OWN: run / "asset.glb", **lay_true_maps(run, capture, out)}
    shutil.rmtree(out / "gt", ignore_errors=True)
    scored = truth_subset(capture / "gt", views, out / "gt").parent
    cameras, rows = None if (capture / "transforms.json").is_file() else run / "cameras.json", []
    for maps, asset in assets.items():
        found = score(scored, asset, cameras, scorer)
        figures = {column: round(float(found[key]), 4) for column, key in FIGURES.items()}
        rows.append(Row(name, maps, views, current_commit(), **figures))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the assets, score them, write the rows and print the table; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("objects", type=Path)
    parser.add_argument("--only", type=lambda text: text.split(","), metavar="NAME,…", help="all with a finished run by default")
    parser.add_argument("--views", type=int, default=0, help="0: all")
    parser.add_argument("--scorer", type=Path, default=SCORER)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    runs = finished_runs(options.objects)
    if missing := sorted(set(options.only or ()) - set(runs)) or ([] if runs else ["any object"]):
        parser.error(f"{options.objects} has no finished run of {missing[0]} with its capture; `python -m benchmarks.objects` makes both")
    if not PYTHON.is_file() or not (options.scorer / "score.py").is_file():
        parser.error(f"the scorer is not installed: run `make score` once (its folder: {options.scorer})")
    rows: list[Row] = []
    failed = False
    for name in options.only or sorted(runs):
        try:
            rows += measure(name, runs[name], options.objects, options.views, options.scorer)
        except (GsbakeError, subprocess.CalledProcessError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            failed = True
            continue
        write_rows(options.csv, [*read_rows(options.csv, Row), *rows])
        print(markdown([row for row in rows if row.object == name]), flush=True)
    print(markdown(rows))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
