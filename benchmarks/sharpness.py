"""How sharp textures are beside photos that made no part of them, and how sharp one photo alone would be on the same mesh.

python -m benchmarks.sharpness OUT [--only axe_full,printed] [--profile preview] [--set section.key=value ...] [--captures DIR]
    [--scorer DIR] [--csv FILE]

Each capture is baked with `train.holdout=4` into OUT/runs and scored at 1200 and 2592 pixels (at their own size where photos are smaller)
on its test photos, at full size and undistorted, by `sharpness.py` of the scorer, whose environment `make score` installs. The ceiling is
the same mesh with the nearest other photo laid on it, one asset per test photo; what that photo does not see keeps the baked colour.
Seconds are those of the whole command.

The objects of `objects/fine_render.py` are rendered into OUT/captures. Their base colour is known, and scored too: it stands in place of
the test photos.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.ceiling import finished_folders
from benchmarks.csv_rows import current_commit, read_rows, today, write_rows
from benchmarks.objects.__main__ import PYTHON, SCORER, bake
from benchmarks.objects.fine_render import FINE_MODELS, render_fine
from benchmarks.timeline import ROOT
from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.photos.roles import test_photos
from gsbake.geometry.raycast import RayCaster
from gsbake.gltf.baked import load_mesh_arrays
from gsbake.gltf.export import export_asset
from gsbake.imaging.exr import read_exr, write_exr
from gsbake.imaging.png import write_png
from gsbake.imaging.srgb import decode_bytes
from gsbake.texturing.photo_projection import MASK_MARGIN
from gsbake.texturing.projection import ProjectionBlender, mask_weights
from gsbake.texturing.texels import rasterise

RESULTS = ROOT / "benchmarks" / "results" / "sharpness.csv"
CAPTURES = ("axe_full", "flowerpot", "mary_rose", "skull", "fox", *FINE_MODELS)
SIZES, HOLDOUT = (1200, 2592), 4
FIGURES = ("psnr", "detail", "fine_1", "fine_2", "fine_4", "aligned_1", "aligned_2", "aligned_4", "shift")


@dataclass(frozen=True)
class Row:
    """Medians over the test photos of a capture at one size, of the baked asset or of its `ceiling`, beside the photos or the `truth`;
    seconds of the run, peak memory of its stages and the disk that the run and the photos take, in MB."""

    capture: str
    profile: str
    settings: str
    texture: str
    beside: str
    size: int
    photos: int
    psnr: float
    detail: float
    fine_1: float
    fine_2: float
    fine_4: float
    aligned_1: float
    aligned_2: float
    aligned_4: float
    shift: float
    seconds: float
    stages: str
    peak_mb: float
    disk_mb: float
    photos_mb: float
    commit: str = field(default_factory=current_commit)
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one key replace each other."""
        return self.capture, self.profile, self.settings, self.texture, self.beside, str(self.size), self.commit


def full_cameras(cameras: Path, photos: FullPhotos, out: Path) -> Path:
    """The `cameras.json` of an asset with the test photos alone, at full size; the photos and their masks are written beside it."""
    document = json.loads(cameras.read_text(encoding="utf-8"))
    tested, frames = test_photos(len(photos), HOLDOUT), []
    for index in tested:
        view = photos.view(index)
        frame = document["frames"][index]
        known = {key: float(frame.get(key, document.get(key))) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        across, down = view.camera.width / known["w"], view.camera.height / known["h"]
        name = view.camera.name
        frames.append(
            {
                "file_path": f"{name}.png", "transform_matrix": frame["transform_matrix"], "w": view.camera.width, "h": view.camera.height,
                "fl_x": across * known["fl_x"], "cx": across * known["cx"], "fl_y": down * known["fl_y"], "cy": down * known["cy"],
            }
        )  # fmt: skip
        for kind, pixels in (("photos", view.rgb), ("masks", view.mask)):
            if pixels is not None:
                (out / kind).mkdir(parents=True, exist_ok=True)
                write_png(out / kind / f"{name}.png", pixels)
    path = out / "cameras.json"
    path.write_text(json.dumps({"frames": frames}), encoding="utf-8")
    return path


def score(asset: Path, cameras: Path, size: int, scorer: Path, names: Sequence[str] = ()) -> dict[str, dict[str, float]]:
    """{photo: figures} of an asset at `size` pixels, of all photos of `cameras` or of those with `names`."""
    folder = cameras.parent
    command = [str(PYTHON), str(scorer / "sharpness.py"), str(asset), str(cameras), str(folder / "photos"), "--size", str(size)]
    command += ["--masks", str(folder / "masks")] if (folder / "masks").is_dir() else []
    command += ["--names", ",".join(names)] if names else []
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    columns = ("psnr", "ssim", *FIGURES[1:])
    return {row[0]: dict(zip(columns, row[1:], strict=True)) for row in found["rows"]}


def lay_photo(folders: dict[str, Path], photos: FullPhotos, index: int, out: Path) -> Path:
    """The asset with the texture of photo `index` where it sees the surface."""
    baked = out / "baked"
    shutil.rmtree(baked, ignore_errors=True)
    shutil.copytree(folders["bake"], baked)
    mesh, image = load_mesh_arrays(baked / "mesh.safetensors"), read_exr(baked / "base_color.exr")
    texels, faces, view = rasterise(mesh["uv"], mesh["faces"], len(image)), mesh["faces"], photos.view(index)
    position, normal = (texels.interpolate(mesh[name], faces) for name in ("position", "normal"))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    blender = ProjectionBlender(position, normal, RayCaster(mesh["position"], faces), 3, 0.0)
    weights = None if view.mask is None else mask_weights(view.mask, MASK_MARGIN * max(view.mask.shape))
    blender.add(view.camera, decode_bytes(view.rgb), weights)
    laid = blender.result()
    image.reshape(-1, 3)[texels.index[laid.observed]] = laid.values[laid.observed]
    write_exr(baked / "base_color.exr", image)
    export_asset(folders["ingest"], folders["poses"], folders["refine"], baked, out)
    return out / "asset.glb"


def nearest_photo(photos: FullPhotos, index: int) -> int:
    """The photo whose camera stands nearest to that of photo `index`."""
    centres = np.array([camera.centre for camera in photos.posed.cameras.cameras])
    distance = np.linalg.norm(centres - centres[index], axis=1)
    distance[index] = np.inf
    return int(distance.argmin())


def true_colours(capture: Path, cameras: Path) -> Path:
    """The cameras of `cameras` with the true base colour of `capture` as photos, and its alpha as masks; a file like it."""
    out = cameras.parent / "truth"
    for frame in json.loads(cameras.read_text(encoding="utf-8"))["frames"]:
        rgba = np.asarray(Image.open(capture / "gt" / "base_color" / frame["file_path"]))
        for kind, pixels in (("photos", rgba[..., :3]), ("masks", rgba[..., 3])):
            (out / kind).mkdir(parents=True, exist_ok=True)
            write_png(out / kind / frame["file_path"], pixels)
    return Path(shutil.copy(cameras, out / "cameras.json"))


def measure(capture: Path, out: Path, arguments: argparse.Namespace, rendered: bool) -> list[Row]:
    """The rows of one capture, baked into `out`; of one that was `rendered` the true base colour is known."""
    settings = [f"train.holdout={HOLDOUT}", *arguments.settings]
    seconds = bake(capture, out, argparse.Namespace(profile=arguments.profile, seed=0, settings=settings))
    manifests = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(out.glob("stages/*/*/manifest.json"))]
    stages = " ".join(f"{stage['stage']}={stage['seconds']:.0f}" for stage in manifests)
    peak, disk = (1e-6 * total for total in (max(stage["peak_bytes"] for stage in manifests), _size(out)))
    taken = next(capture / name for name in ("photos", "images") if (capture / name).is_dir())
    folders, beside, rows = finished_folders(out), out.parent / f"{out.name}-sharpness", []
    with FullPhotos(folders["ingest"], folders["poses"], folders["refine"]) as photos:
        cameras = full_cameras(out / "cameras.json", photos, beside)
        names = {index: photos.posed.cameras.cameras[index].name for index in test_photos(len(photos), HOLDOUT)}
        laid = {name: lay_photo(folders, photos, nearest_photo(photos, index), beside / name) for index, name in names.items()}
        longest = max(max(photos.camera(index).width, photos.camera(index).height) for index in names)
    truth = true_colours(capture, cameras) if rendered else None
    for size in sorted({min(size, longest) for size in SIZES}):
        ceiling: dict[str, dict[str, float]] = {}
        for name, asset in laid.items():
            ceiling |= score(asset, cameras, size, arguments.scorer, [name])
        scored = [("baked", "photos", score(out / "asset.glb", cameras, size, arguments.scorer)), ("ceiling", "photos", ceiling)]
        if truth is not None:
            scored.append(("baked", "truth", score(out / "asset.glb", truth, size, arguments.scorer)))
        for texture, against, found in scored:
            figures: dict[str, Any] = {name: round(median(one[name] for one in found.values()), 3) for name in FIGURES}
            rows.append(
                Row(
                    capture.name, arguments.profile, " ".join(arguments.settings), texture, against, size, len(found), **figures,
                    seconds=seconds, stages=stages, peak_mb=round(peak, 1), disk_mb=round(disk, 1),
                    photos_mb=round(1e-6 * _size(taken), 1),
                )
            )  # fmt: skip
    return rows


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the captures one by one, and write each at once."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", type=lambda text: text.split(","), metavar="NAME,…", default=CAPTURES)
    parser.add_argument("--profile", default="preview")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--captures", type=Path, default=ROOT.parent / "shared" / "captures")
    parser.add_argument("--scorer", type=Path, default=SCORER)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    for name in options.only:
        capture = render_fine(name, options.out / "captures") if name in FINE_MODELS else options.captures / name
        run = options.out / "runs" / "-".join([options.profile, *sorted(options.settings)]) / name
        run.parent.mkdir(parents=True, exist_ok=True)
        rows = measure(capture, run, options, name in FINE_MODELS)
        write_rows(options.csv, [*read_rows(options.csv, Row), *rows])
        for row in rows:
            print(row, flush=True)


if __name__ == "__main__":
    main()
