"""Large renders of the objects of `fine`, whose base colour has 4096² texels, with the true base colour as every photo shows it.

python -m benchmarks.objects.fine_render OUT [--only printed,stoneware]

gsbake's own renderer draws them: one studio light, four rays a pixel, noise of NOISE, no shadows or reflections of the object in itself.
OUT/NAME has `images/` and `transforms.json`, and in `gt/` the true object and `base_color/`, unlit and without noise.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.objects import fine
from benchmarks.objects.models import bottle, figurine, model_glb
from benchmarks.objects.parts import Array, Material
from benchmarks.truth import Z_UP
from gsbake.geometry.cameras import Camera
from gsbake.imaging.png import encode_png
from gsbake.imaging.srgb import encode_bytes
from gsbake.report.asset import open_asset
from gsbake.report.render import Renderer
from gsbake.synth.capture import look_at
from gsbake.viewing.lights import load_light

VIEWS, SIZE, TEXTURE_SIZE, LIGHT = 24, 2048, 4096, "studio"
#: Standard deviation of the photos' noise, of 255; field of view in degrees; elevations in degrees.
NOISE, FIELD_OF_VIEW, ELEVATIONS = 1.5, 40.0, (-15.0, 70.0)
#: Rows of a photo that are drawn at once.
ROWS = 256
#: Diffuse and bulgy; slightly glossy and turned.
FINE_MODELS: dict[str, tuple[Callable[[], trimesh.Trimesh], Callable[[Array], Material]]] = {
    "printed": (lambda: figurine(3, 0.12), fine.printed_material),
    "stoneware": (bottle, fine.stoneware_material),
}


def cameras(centre: Array, radius: float, views: int = VIEWS, size: int = SIZE) -> list[Camera]:
    """Cameras (+Z up) around a sphere, which fills the photos; golden angles between the elevations."""
    focal = 0.5 * size / math.tan(math.radians(FIELD_OF_VIEW / 2))
    distance = 1.03 * radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
    low, high = np.sin(np.radians(ELEVATIONS))
    found = []
    for index in range(views):
        up, azimuth = low + (high - low) * (index + 0.5) / views, index * math.pi * (3 - math.sqrt(5))
        away = np.array([math.sqrt(1 - up**2) * math.cos(azimuth), math.sqrt(1 - up**2) * math.sin(azimuth), up])
        found.append(look_at(f"{index:04d}", centre + distance * away, centre, 0.0, focal, (0.5 * size, 0.5 * size), size))
    return found


def render_fine(name: str, out: Path, views: int = VIEWS, size: int = SIZE, texture: int = TEXTURE_SIZE) -> Path:
    """The capture of an object in OUT/NAME, rendered unless it is there."""
    capture, done = out / name, out / name / "transforms.json"
    if done.is_file():
        return capture
    for folder in (capture / "images", capture / "gt" / "base_color"):
        folder.mkdir(parents=True, exist_ok=True)
    shape, procedure = FINE_MODELS[name]
    model = capture / "gt" / "asset.glb"
    model.write_bytes(model_glb(shape(), procedure, texture))
    asset = open_asset(model)
    renderer, shader = Renderer(asset), load_light(LIGHT, out)
    placed = cameras(Z_UP @ asset.centre, asset.radius, views, size)
    for index, camera in enumerate(placed):
        rng, own = np.random.default_rng(index), replace(camera, R=camera.R @ Z_UP)
        photo, base = np.zeros((size, size, 4), np.uint8), np.zeros((size, size, 4), np.uint8)
        for start in range(0, size, ROWS):
            rows = slice(start, min(size, start + ROWS))
            drawn = renderer.draw(replace(own, height=rows.stop - start, cy=own.cy - start), shader)
            photo[rows, :, :3], base[rows, :, :3] = encode_bytes(drawn.linear), encode_bytes(drawn.base_color)
            photo[rows, :, 3] = base[rows, :, 3] = np.round(255 * drawn.alpha)
        noisy = photo[..., :3] + rng.normal(0, NOISE, (size, size, 3))
        photo[..., :3] = np.where(photo[..., 3:] > 0, np.clip(np.round(noisy), 0, 255), 0)
        (capture / "images" / f"{camera.name}.png").write_bytes(encode_png(photo, 1))
        (capture / "gt" / "base_color" / f"{camera.name}.png").write_bytes(encode_png(base, 1))
    frames = [{"file_path": f"images/{camera.name}.png", "transform_matrix": camera.camera_to_world_opengl().tolist()} for camera in placed]
    first = placed[0]
    intrinsics = {"fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": size, "h": size}
    done.write_text(json.dumps(intrinsics | {"frames": frames}, indent=1), encoding="utf-8")
    return capture


def main() -> None:
    """Render the captures that are not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", type=lambda text: text.split(","), metavar="NAME,…", default=list(FINE_MODELS))
    arguments = parser.parse_args()
    for name in arguments.only:
        print(render_fine(name, arguments.out), flush=True)


if __name__ == "__main__":
    main()
