"""Materials on the true mesh: a finished run's photos and cameras baked onto the true shape, so that only the materials can be wrong.

python -m benchmarks.true_mesh RUN CAPTURE OUT [--profile relight] [--set section.key=value ...]

RUN is the output folder of a run on CAPTURE, whose photos came with poses; CAPTURE/gt has the true asset. Writes OUT/asset.glb, to be
scored like any other, and prints the decisions and figures of the bake. The difference to the score of RUN is what the shape costs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.truth import read_truth
from gsbake.config.load import load_profile
from gsbake.errors import GsbakeError, UsageError
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.ply import write_mesh
from gsbake.gltf.export import ExportOptions, export_asset
from gsbake.materials.bake import BakeOptions, bake_textures
from gsbake.monitor import SilentMonitor
from gsbake.pipeline.store import Store


class _Printed(SilentMonitor):
    """Prints decisions."""

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        print(f"{what}: {choice} ({evidence})", flush=True)


def bake_on_true_mesh(run: Path, capture: Path, out: Path, profile: str = "relight", overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Bake the photos of `run` onto the true mesh of `capture`, write `out`/asset.glb, and return the figures of the bake.

    Raises UsageError when the run's cameras were not given, as its frame then is not that of the truth.
    """
    settings, store = load_profile(profile, overrides).profile, Store(run)
    ingest, poses, surfels = (store.manifests(stage)[0][0] for stage in ("ingest", "poses", "refine"))
    cameras = CameraSet.load(poses / "cameras.json")
    if cameras.poses != "given":
        raise UsageError(f"{run}: the cameras were not given, so that the true mesh lies in another frame.")
    truth = read_truth(capture).surface
    mesh, baked = out / "mesh", out / "bake"
    for folder in (mesh, baked):
        folder.mkdir(parents=True, exist_ok=True)
    corners, faces = np.unique(truth.vertices, axis=0, return_inverse=True)  # joined where charts split them
    vertices = cameras.to_world.inverse().apply(corners)
    for name in ("mesh.ply", "dense.ply"):
        write_mesh(mesh / name, vertices, np.asarray(faces).reshape(-1)[truth.faces])
    figures = bake_textures(ingest, poses, surfels, mesh, baked, BakeOptions.of(settings), monitor=_Printed())
    export = ExportOptions(settings.export, settings.bake.materials, settings.scale)
    export_asset(ingest, poses, surfels, baked, out, export)
    return figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--profile", default="relight")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    options = parser.parse_args(arguments)
    try:
        figures = bake_on_true_mesh(options.run, options.capture, options.out, options.profile, options.overrides)
    except GsbakeError as error:
        print(f"true_mesh: {error}", file=sys.stderr)
        return error.exit_code
    print("\n".join(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}" for name, value in figures.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
