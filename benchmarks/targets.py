"""Bytes, triangles, distance to the dense mesh and relit PSNR of every target and level of finished runs.

python -m benchmarks.targets OUT… [--score "PYTHON SCORE.PY" --truth OUT=CAPTURE/gt …] [--render NAME …]

OUT is the output folder of `gsbake run … --target …`. Distances are those of `gsbake compare`: chamfer distance as a share of the dense
mesh's diagonal. `--score` is the independent scorer, which renders the asset in Blender under lights that lit no photo; it reads neither
KTX2 nor meshoptimizer, so such files are decoded by gsbake's reader and written plainly first. `--render` names the files that it renders;
default: all of level 0. Rows go to benchmarks/results/targets.csv, each with commit, host, seed and date; rows of other files stay.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import shlex
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.csv_rows import today
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.ply import read_mesh
from gsbake.gltf.frame import frame_between, read_transforms_json
from gsbake.gltf.scene import open_scene
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.imaging.encoded import decode_image
from gsbake.imaging.png import encode_png
from gsbake.viewing.compare import Surface, compare_surfaces, surface_of

RESULTS = Path(__file__).parent / "results" / "targets.csv"


@dataclass(frozen=True)
class Row:
    """One file of one run; `chamfer_pct` in % of the dense mesh's diagonal, PSNR in dB, None where it was not rendered."""

    capture: str
    file: str
    target: str
    level: int
    bytes: int
    triangles: int
    texture: int
    chamfer_pct: float
    relight_psnr: float | None = None
    relight_psnr_scaled: float | None = None
    commit: str = ""
    host: str = ""
    seed: int = 0
    date: str = field(default_factory=today)


def rows_of(out: Path, commit: str) -> list[Row]:
    """A row for asset.glb and for every GLB of the run's targets, without renders."""
    stages = {name: _newest(out, name) for name in ("poses", "refine", "mesh", "export", "targets")}
    unit = PosedPhotos.open(stages["poses"], stages["refine"]).cameras.cameras
    frame = frame_between(unit, read_transforms_json(stages["export"] / "cameras.json"))
    vertices, faces = read_mesh(stages["mesh"] / "dense.ply")
    dense = Surface(frame.apply(vertices), faces)
    manifest = json.loads((stages["targets"] / "manifest.json").read_text())
    capture = Path(json.loads((out / "project.json").read_text())["photos"])
    name = capture.parent.name if capture.name in ("images", "photos") else capture.name
    common = {"commit": commit, "host": f"{platform.node()}: {manifest['host'].get('cpu', '')}", "seed": _seed(out)}
    listed: dict[str, dict[str, Any]] = {"asset.glb": {"target": "default", "level": 0}} | json.loads(
        (stages["targets"] / "targets.json").read_text()
    )
    found = []
    for file, entry in listed.items():
        if not file.endswith(".glb") or "levels" in entry:
            continue
        path = out / file
        scene = open_scene(path)
        chamfer = compare_surfaces(dense, surface_of(scene))["chamfer"]
        texels = decode_image(scene.document.image(0), file).shape[0]
        triangles = len(scene.faces)
        found.append(
            Row(name, file, entry["target"], entry["level"], path.stat().st_size, triangles, texels, 100 * chamfer, **common)  # type: ignore[arg-type]
        )
    return found


def scored(row: Row, out: Path, truth: Path, score: Sequence[str]) -> Row:
    """The row with the scorer's relit PSNR."""
    with tempfile.TemporaryDirectory() as scratch:
        asset, report = Path(scratch) / "asset.glb", Path(scratch) / "score.json"
        asset.write_bytes(plain(out / row.file))
        command = [*score, str(truth), str(asset), "--json", str(report)]
        poses = json.loads((out / "cameras.json").read_text())["poses"]
        if poses != "given":
            command += ["--cameras", str(out / "cameras.json")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        figures = json.loads(report.read_text())
    return replace(row, relight_psnr=figures["relight_psnr"], relight_psnr_scaled=figures["relight_psnr_scaled"])


def plain(path: Path) -> bytes:
    """The bytes of a file of one mesh with float vertices and PNG images."""
    scene = open_scene(path)
    part, material = scene.parts[0], scene.materials[scene.parts[0].material]
    assert part.tangent is not None
    mesh = GltfMesh(part.position.astype(np.float32), part.normal, part.tangent, part.uv[0], part.faces)

    def image(role: str) -> bytes | None:
        use = material.textures.get(role)
        return None if use is None else encode_png(decode_image(scene.document.image(use.image), role)[..., :3])

    base, packed = image("base_color"), image("orm") or image("occlusion")
    assert base is not None and packed is not None
    factors = None if "orm" in material.textures else (material.roughness, material.metallic)
    if factors is not None:
        packed = encode_png(decode_image(packed, "occlusion")[..., 0])
    return build_glb(mesh, GltfTextures(base, packed, image("normal"), image("emissive")), "asset", "gsbake", factors=factors)


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Write rows, and those already there of other captures and files."""
    new = list(rows)
    again = {(row.capture, row.file) for row in new}
    old = [row for row in read_csv(path) if (row.capture, row.file) not in again]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Row)], lineterminator="\n")
        writer.writeheader()
        for row in sorted([*old, *new], key=lambda r: (r.capture, r.target != "default", r.target, r.level)):
            writer.writerow({k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(row).items()})


def read_csv(path: Path) -> list[Row]:
    """The rows of a file written by `write_csv`; none without it."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [_row(line) for line in csv.DictReader(file)]


def _row(line: dict[str, str]) -> Row:
    whole = {k: int(line[k]) for k in ("level", "bytes", "triangles", "texture", "seed")}
    real = {k: float(line[k]) if line[k] else None for k in ("chamfer_pct", "relight_psnr", "relight_psnr_scaled")}
    return Row(**line | whole | real)  # type: ignore[arg-type]


def _newest(out: Path, stage: str) -> Path:
    manifests = sorted((out / "stages" / stage).glob("*/manifest.json"), key=lambda path: path.stat().st_mtime)
    if not manifests:
        raise SystemExit(f"{out} has no output of the stage {stage}.")
    return manifests[-1].parent


def _seed(out: Path) -> int:
    return int(json.loads((out / "project.json").read_text()).get("seed") or 0)


def main() -> None:
    """Measure and write the CSV file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--score", help="interpreter and script of the independent scorer")
    parser.add_argument("--truth", action="append", default=[], metavar="OUT=GT", help="folder with the truth of a run; repeatable")
    parser.add_argument("--render", action="append", default=[], metavar="NAME", help="file that is rendered; default: all of level 0")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    truths = dict(pair.split("=", 1) for pair in options.truth)
    for out in options.runs:
        rows = rows_of(out, commit)
        write_csv(options.results, rows)
        for row in rows:
            wanted = row.file in options.render or (not options.render and row.level == 0)
            if options.score and str(out) in truths and wanted:
                write_csv(options.results, [scored(row, out, Path(truths[str(out)]), shlex.split(options.score))])
    print(f"The rows are in {options.results}; `make lab` writes the tables.")


if __name__ == "__main__":
    main()
