"""Upper bound of materials: the asset of a finished run with the true maps laid on its mesh.

python -m benchmarks.upper_bound RUN CAPTURE OUT [--normals]

RUN is the folder of a finished run, CAPTURE has the reference in `gt/`. Every texel gets the base colour, roughness and metallic of the
nearest point of the reference; mesh, normal map and occlusion stay. The asset in OUT is scored like any other: what it lacks to a perfect
score is due to the shape and its normals, and the rest of the run's own loss to its materials. With `--normals` the normal map has the
reference's normals too, which leaves the shape.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.maps import true_normals, true_values
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


def lay_true_maps(run: Path, capture: Path, out: Path, normals: bool = False) -> None:
    """Write the asset of `run` with the true maps of `capture` to `out`. Raises UsageError when the run is not finished."""
    from safetensors.numpy import load_file

    folder = finished_folders(run)
    baked = out / "baked"
    shutil.rmtree(baked, ignore_errors=True)
    shutil.copytree(folder["bake"], baked)
    (baked / "emissive.exr").unlink(missing_ok=True)
    unwrapped, orm = load_file(baked / "mesh.safetensors"), read_exr(baked / "orm.exr")
    texels = rasterise(unwrapped["uv"], unwrapped["faces"], len(orm))
    points = texels.interpolate(unwrapped["position"], unwrapped["faces"])
    maps = np.zeros((orm.shape[0] * orm.shape[1], 8), np.float32)
    maps[texels.index, :5] = true_values(points, folder["mesh"], folder["poses"], capture)
    if normals:
        smooth, tangent = (texels.interpolate(unwrapped[name], unwrapped["faces"]) for name in ("normal", "tangent"))
        reference = true_normals(points, folder["mesh"], folder["poses"], capture)
        samples = DenseSamples(np.ones(len(reference), bool), points.astype(np.float64), reference, 0.0)
        maps[texels.index, 5:] = normal_map(samples, smooth, tangent)
    empty = np.ones(orm.shape[:2], bool)
    empty.reshape(-1)[texels.index] = False
    row, column = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    padded = maps.reshape(*orm.shape[:2], 8)[row, column]
    write_exr(baked / "base_color.exr", padded[..., :3])
    write_exr(baked / "orm.exr", np.concatenate([orm[..., :1], padded[..., 3:5]], 2))
    if normals:
        write_exr(baked / "normal.exr", padded[..., 5:])
    export_asset(folder["ingest"], folder["poses"], folder["refine"], baked, out, ExportOptions())


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("run", "capture", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--normals", action="store_true", help="the reference's normals as well")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        lay_true_maps(options.run, options.capture, options.out, options.normals)
    except GsbakeError as error:
        print(f"upper_bound: {error}", file=sys.stderr)
        return error.exit_code
    print(options.out / "asset.glb")
    return 0


if __name__ == "__main__":
    sys.exit(main())
