"""The present picture of a run: surfels of the last checkpoint, then those of the finished stages, then the mesh, then the asset.

It is drawn by a process of its own at low priority, `python -m gsbake.studio.picture OUT FILE TRANSFER` (JPEG on standard output): the
process that serves the page then imports neither torch nor kernels, and training loses as little as possible.
"""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.python_process import python_command, python_environment
from gsbake.system.processes import lower_priority

#: Longer side of the picture in pixels; JPEG quality; grey behind the object.
SIZE, QUALITY, GREY = 384, 85, 0.86
#: Seconds that a picture may take.
TIMEOUT = 120.0
#: Files that can be drawn, the latest stage first.
SOURCES = (
    ("export", "asset.glb"), ("mesh", "dense.ply"), ("refine", "surfels.safetensors"), ("refine", "checkpoint.safetensors"),
    ("train", "surfels.safetensors"), ("train", "checkpoint.safetensors"),
)  # fmt: skip


@dataclass(frozen=True)
class Source:
    """A file that can be drawn, and when it was written."""

    path: Path
    time: float


def newest_source(out: Path, since: float) -> Source | None:
    """What shows the present state of the run in `out`: the newest file of SOURCES written after `since` (seconds of the epoch)."""
    found = []
    for stage, name in SOURCES:
        for path in (out / "stages" / stage).glob(f"*/{name}"):
            with suppress(OSError):
                found.append(Source(path, path.stat().st_mtime))
    return max((s for s in found if s.time >= since), key=lambda s: s.time, default=None)


def draw_in_process(out: Path, source: Path, transfer: str) -> bytes | None:
    """JPEG of a source, drawn by a child at low priority; None where that fails, as while a stage replaces the file."""
    command = python_command("-m", "gsbake.studio.picture", str(out), str(source), transfer)
    try:
        done = subprocess.run(command, capture_output=True, env=python_environment({"OMP_NUM_THREADS": "1"}), timeout=TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 and done.stdout[:2] == b"\xff\xd8" else None


def draw(out: Path, source: Path, transfer: str) -> NDArray[np.float32]:
    """sRGB picture (h, w, 3) of a source from the first camera of the run."""
    from gsbake.geometry.cameras import CameraSet

    poses = sorted((out / "stages" / "poses").glob("*/cameras.json"), key=lambda path: path.stat().st_mtime)[-1]
    cameras = CameraSet.load(poses)
    camera = cameras.cameras[0].downscaled_to(SIZE)
    if source.suffix == ".safetensors":
        return _surfels(source, transfer, camera)
    if source.suffix == ".ply":
        from gsbake.geometry.ply import read_mesh

        return _shape(*read_mesh(source), camera)
    from gsbake.gltf.frame import read_transforms_json
    from gsbake.gltf.scene import open_scene
    from gsbake.report.lights import procedural
    from gsbake.viewing.render import SceneRenderer

    own = read_transforms_json(source.parent / "cameras.json")[0].downscaled_to(SIZE)
    image = SceneRenderer(open_scene(source)).draw(own, procedural("Studio"))
    return np.asarray(image.over(GREY), np.float32)


def _surfels(source: Path, transfer: str, camera: Any) -> NDArray[np.float32]:
    from gsbake.checkpoint import load_checkpoint
    from gsbake.kernels.threads import configure
    from gsbake.surfels.model import Surfels
    from gsbake.surfels.renderer import SurfelRenderer
    from gsbake.surfels.transfer import transfer_by_name

    configure(1)
    if source.name.startswith("checkpoint"):
        surfels = Surfels.from_tensors(load_checkpoint(source)["trainer"]["surfels"], transfer_by_name(transfer))
    else:
        surfels = Surfels.load(source)
    planes = SurfelRenderer(surfels, None).gbuffer(camera)
    colour = planes["colour"] if "colour" in planes else np.clip(planes["albedo"], 0, 1) ** (1 / 2.2)
    cover = planes["alpha"][..., None]
    return np.asarray(colour * cover + GREY * (1 - cover), np.float32)


def _shape(vertices: NDArray[Any], faces: NDArray[Any], camera: Any) -> NDArray[np.float32]:
    """The mesh in grey, brighter where it faces the camera."""
    from gsbake.geometry.raycast import RayCaster
    from gsbake.texturing.normal_map import vertex_normals

    rays = camera.rays().reshape(-1, 3)
    hits = RayCaster(vertices, faces, 1).first_hit(camera.centre[None], rays)
    normal = vertex_normals(vertices, faces)[np.asarray(faces)[np.maximum(hits.face, 0)]]
    facing = -np.einsum("nk,nkd,nd->n", hits.bary, normal, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    grey = np.where(hits.hit, 0.15 + 0.7 * np.clip(facing, 0, 1), GREY)
    return np.repeat(grey.reshape(camera.height, camera.width, 1), 3, 2).astype(np.float32)


def main() -> None:
    """Draw one source and write the JPEG to standard output."""
    import cv2

    lower_priority()
    out, source, transfer = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
    pixels = np.asarray(np.rint(255 * np.clip(draw(out, source, transfer), 0, 1)), np.uint8)
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        sys.exit(1)
    sys.stdout.buffer.write(data.tobytes())


if __name__ == "__main__":
    main()
