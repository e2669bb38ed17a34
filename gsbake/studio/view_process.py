"""The child process that draws the asset from the cameras of photos, with the report's renderer and light: see `limited_process`.

It keeps the asset that it drew last. The server imports neither torch nor kernels, and the child ends when nobody looks.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import GsbakeError
from gsbake.geometry.raycast import RayCaster
from gsbake.gltf.frame import read_transforms_json
from gsbake.imaging.exr import write_hdr
from gsbake.kernels.threads import configure
from gsbake.limited_process import serve
from gsbake.report import compose, coverage
from gsbake.report.asset import open_asset
from gsbake.report.lights import PROCEDURAL_LIGHTS, procedural
from gsbake.report.render import Renderer
from gsbake.shading.light_motion import LightMotion
from gsbake.system.processes import lower_priority

#: Longer side of a picture in pixels, its quality as JPEG, and the height of a light's map.
SIZE, QUALITY, LIGHT_HEIGHT = 800, 88, 128


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Figures of the view, or places in words; {"error": sentence}."""
    folders = {name: Path(path) for name, path in request.get("folders", {}).items()}
    target = Path(request.get("target", "."))
    try:
        match request["task"]:
            case "view":
                return _view(folders, request["name"], target)
            case "lights":
                for name in PROCEDURAL_LIGHTS:
                    write_hdr(target / f"{name.lower()}.hdr", procedural(name).equirectangular(LIGHT_HEIGHT))
                return {}
            case _:
                return {"places": _places(folders)}
    except GsbakeError as error:
        return {"error": str(error)}


def _view(folders: dict[str, Path], name: str, target: Path) -> dict[str, Any]:
    """Write photo.jpg, render.jpg and error.jpg of one photo."""
    renderer, posed, cameras, shader = _opened(*(folders[stage] for stage in ("poses", "refine", "bake", "export")))
    index = next(k for k, camera in enumerate(posed.cameras.cameras) if camera.name == name)
    (score,) = compose.score_views(renderer, shader, posed, cameras, [index], False, SIZE, lambda done, total: None)
    images = {
        "photo": score.metrics.photo, "render": score.metrics.render, "error": compose.heat_map(score.metrics.photo, score.metrics.render)
    }  # fmt: skip
    for kind, pixels in images.items():
        _write(target / f"{kind}.jpg", pixels)
    return {"psnr": round(float(score.metrics.psnr), 2), "ssim": round(float(score.metrics.ssim), 4)}


@lru_cache(maxsize=1)
def _opened(poses: Path, refine: Path, bake: Path, export: Path) -> tuple[Any, PosedPhotos, Any, Any]:
    light = bake / "light.safetensors"
    posed = PosedPhotos.open(poses, refine)
    cameras = read_transforms_json(export / "cameras.json")
    asset = open_asset(export / "asset.glb", unlit=not light.exists())
    learnt = None
    if light.exists():
        learnt = compose.learnt_shader(light, compose.light_rotation(cameras[0], posed.cameras.cameras[0]))
    shader = compose.photo_shader(learnt, LightMotion.load(bake / "light_motion.json"))
    return Renderer(asset, 1), posed, cameras, shader


def _places(folders: dict[str, Path]) -> list[dict[str, Any]]:
    """Directions for further photos, in words, with the share of the unseen surface that each shows."""
    asset = open_asset(folders["export"] / "asset.glb", unlit=True)
    points = coverage.surface_points(asset, folders["bake"] / "coverage.exr")
    if points is None:
        return []
    found = coverage.proposals(points, RayCaster(asset.position, asset.faces, 1), asset.radius)
    return [{"where": coverage.in_words(direction), "share": round(share, 3)} for direction, share in found]


def _write(path: Path, pixels: NDArray[Any]) -> None:
    coded = np.asarray(np.rint(255 * np.clip(pixels, 0, 1)), np.uint8)
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(coded[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    path.write_bytes(data.tobytes())


def main() -> None:
    """Answer requests until the server closes the pipe."""
    lower_priority()
    configure(1)
    serve(answer)
