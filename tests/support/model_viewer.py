"""GLB files in model-viewer, from a camera of our own, under a light of our own."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsbake.gltf.scene import Scene
from gsbake.report.lights import procedural
from gsbake.viewing.render import SceneRenderer
from gsbake.viewing.turntable import ELEVATION, HALF_ANGLE, orbit
from tests.support.browser import picture, served, visit
from tests.support.node import MODULES

VIEWER = Path(__file__).resolve().parents[2] / "gsbake/report/vendor/model-viewer.min.js"
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<style>html, body {{ margin: 0; }} model-viewer {{ width: {pixels}px; height: {pixels}px; --poster-color: transparent; }}</style>
<script src="/model-viewer.min.js"></script>
<script>self.ModelViewerElement = {{ meshoptDecoderLocation: '/meshopt_decoder.js', ktx2TranscoderLocation: '/basis/' }};</script>
<model-viewer src="/asset.glb" environment-image="/light.hdr" tone-mapping="linear" exposure="1" shadow-intensity="0"
  interaction-prompt="none" camera-target="{x}m {y}m {z}m" camera-orbit="0deg {polar}deg {distance}m" field-of-view="30deg"
  min-field-of-view="10deg" max-field-of-view="60deg" min-camera-orbit="-Infinity 0deg 0m" max-camera-orbit="Infinity 180deg {far}m"
  interpolation-decay="1"></model-viewer>"""
READY = "document.querySelector('model-viewer').loaded && document.querySelector('model-viewer').modelIsVisible"
SETTLED = "new Promise(done => setTimeout(() => done(document.querySelector('model-viewer').toDataURL()), 1500))"


def files_of_viewer() -> dict[str, bytes]:
    """The viewer with its decoders, by path."""
    basis = MODULES / "three/examples/jsm/libs/basis"
    return {
        "model-viewer.min.js": VIEWER.read_bytes(),
        "meshopt_decoder.js": (MODULES / "meshoptimizer/meshopt_decoder.cjs").read_bytes(),
        "basis/basis_transcoder.js": (basis / "basis_transcoder.js").read_bytes(),
        "basis/basis_transcoder.wasm": (basis / "basis_transcoder.wasm").read_bytes(),
    }


def viewed(path: Path, scene: Scene, folder: Path, pixels: int = 320) -> tuple[np.ndarray, dict[str, Any]]:
    """Picture (h, w, 4) 0..1 of a file in model-viewer from the first view of `orbit`, and what the browser reported."""
    renderer = SceneRenderer(scene)
    x, y, z = renderer.centre
    distance = renderer.radius / math.sin(HALF_ANGLE)
    page = PAGE.format(pixels=pixels, x=x, y=y, z=z, polar=90 - math.degrees(ELEVATION), distance=distance, far=10 * distance)
    light = np.ascontiguousarray(procedural("Studio").equirectangular(128)[..., ::-1], np.float32)
    hdr = cv2.imencode(".hdr", light)[1].tobytes()
    files = files_of_viewer() | {"index.html": page.encode(), "asset.glb": path.read_bytes(), "light.hdr": hdr}
    with served(files) as address:
        found = visit(f"{address}/index.html", [{"wait": READY}, {"evaluate": SETTLED}], folder, (pixels, pixels))
    image = picture(found["results"][0])
    return cv2.resize(image, (pixels, pixels), interpolation=cv2.INTER_AREA).astype(np.float32) / 255, found


def rendered(scene: Scene, pixels: int = 320) -> tuple[np.ndarray, np.ndarray]:
    """Our own picture from the same camera: sRGB (h, w, 3) and alpha (h, w)."""
    renderer = SceneRenderer(scene)
    camera = orbit(renderer.centre, renderer.radius, 1, pixels)[0]
    image = renderer.draw(camera, procedural("Studio"), samples=3)
    return image.rgb, image.alpha
