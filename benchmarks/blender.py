"""Whether Blender shows the photos: the exported GLB drawn by Cycles under the exported light from photos' cameras.

python -m benchmarks.blender OUT… --python PYTHON_WITH_BPY [--views N]

Axes, orientation of the light and exposure are those of the files, as anybody imports them. Prints the mean PSNR of Blender's pictures and
of our own renderer's over the same test photos, both measured as the report does; Cycles casts shadows and interreflections that the split
sum of the report leaves out, so the two differ. Exits 1 where Blender's is more than 1 dB below.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsbake.capture.photos.roles import test_photos
from gsbake.capture.posed_photos import PosedPhotos, View
from gsbake.geometry.cameras import Camera
from gsbake.gltf.frame import read_transforms_json
from gsbake.imaging.exr import read_exr
from gsbake.report import compose
from gsbake.report.asset import open_asset
from gsbake.report.quality import compare, select_views
from gsbake.report.render import RenderedImage, Renderer

#: How far Blender's PSNR may lie below the report's, in dB.
TOLERANCE = 1.0
#: Longer side of the pictures in pixels; samples of a pixel.
SIZE, SAMPLES = 400, 64
SCRIPT = Path(__file__).with_name("blender_render.py")


def blender_pictures(python: str, asset: Path, light: Path, cameras: Sequence[Camera], samples: int = SAMPLES) -> list[RenderedImage]:
    """Cycles' pictures of an asset from cameras in its frame."""
    with tempfile.TemporaryDirectory() as folder:
        views = [
            {
                "name": f"view{k}", "width": c.width, "height": c.height, "focal": c.fx, "cx": c.cx, "cy": c.cy,
                "matrix": c.camera_to_world_opengl().tolist(),
            }
            for k, c in enumerate(cameras)
        ]  # fmt: skip
        job = {"asset": str(asset.resolve()), "light": str(light.resolve()), "out": folder, "samples": samples, "views": views}
        path = Path(folder) / "job.json"
        path.write_text(json.dumps(job))
        subprocess.run([python, str(SCRIPT), str(path)], check=True, capture_output=True)
        return [_picture(read_exr(Path(folder) / f"view{k}.exr")) for k in range(len(cameras))]


def _picture(rgba: np.ndarray) -> RenderedImage:
    alpha = np.asarray(rgba[..., 3], np.float32)
    linear = np.asarray(rgba[..., :3] / np.maximum(alpha, 1e-6)[..., None], np.float32)
    empty = np.zeros_like(linear)
    return RenderedImage(linear, alpha, empty, empty, empty)


def figures(out: Path, python: str, views: int) -> tuple[float, float]:
    """Mean PSNR in dB of Blender's pictures and of our own over test photos of the run in `out`."""
    stages = {name: _newest(out, name) for name in ("poses", "refine", "bake", "export")}
    if (stages["bake"] / "light_motion.json").exists():
        raise SystemExit(f"{out}: the light moves from photo to photo; light.hdr is that of the first one alone.")
    posed = PosedPhotos.open(stages["poses"], stages["refine"])
    cameras = read_transforms_json(stages["export"] / "cameras.json")
    holdout = json.loads((stages["bake"] / "manifest.json").read_text())["settings"].get("train.holdout", 8)
    indices, _ = select_views(len(posed), test_photos(len(posed), holdout), views)
    photos: list[View] = [posed.view(index, SIZE) for index in indices]
    scaled = [cameras[i].scaled(v.camera.width, v.camera.height) for i, v in zip(indices, photos, strict=True)]
    theirs = blender_pictures(python, out / "asset.glb", out / "light.hdr", scaled)
    to_light = compose.light_rotation(cameras[0], posed.cameras.cameras[0])
    shader, renderer = compose.learnt_shader(stages["bake"] / "light.safetensors", to_light), Renderer(open_asset(out / "asset.glb"))
    ours = [renderer.draw(camera, shader) for camera in scaled]
    found = [float(np.mean([compare(v, image).psnr for v, image in zip(photos, images, strict=True)])) for images in (theirs, ours)]
    return found[0], found[1]


def _newest(out: Path, stage: str) -> Path:
    manifests = sorted((out / "stages" / stage).glob("*/manifest.json"), key=lambda path: path.stat().st_mtime)
    if not manifests:
        raise SystemExit(f"{out} has no output of the stage {stage}.")
    return manifests[-1].parent


def main() -> None:
    """Print the figures of every run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--python", required=True, help="interpreter that has bpy")
    parser.add_argument("--views", type=int, default=3)
    options = parser.parse_args()
    passed = True
    for out in options.runs:
        theirs, ours = figures(out, options.python, options.views)
        passed = passed and theirs >= ours - TOLERANCE
        print(f"{out.name}: Blender {theirs:.2f} dB, our renderer {ours:.2f} dB over the same photos")
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()
