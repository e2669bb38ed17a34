"""A small finished run: a grey ball seen by eight cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.config.schema import Report
from gsbake.geometry.cameras import Camera, CameraSet, Similarity
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.report.write import ReportOptions, write_report
from gsbake.shading.environment import EnvironmentLight
from tests.report.shapes import ball
from tests.support.cameras import look_at
from tests.support.recorder import Recorder

#: World (Z-up) to glTF (+Y up), by the contract of the export.
WORLD_TO_ASSET = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
DECISION = {"what": "structure from motion", "choice": "skipped", "evidence": "poses given"}
SIZE, VIEWS, RADIUS = 64, 8, 0.7


@dataclass
class Finished:
    """A finished run: folders of its stages, output folder of the report, and the recorded reports."""

    folders: dict[str, Path]
    out: Path
    options: ReportOptions
    monitor: Recorder = field(default_factory=Recorder)

    def report(self) -> dict[str, Any]:
        """Write the report; returns its figures."""
        return write_report(self.folders, self.out, self.options, monitor=self.monitor)


def png(image: np.ndarray) -> bytes:
    done, data = cv2.imencode(".png", image)
    assert done
    return bytes(data.tobytes())


def look_at_origin(name: str, centre: np.ndarray) -> Camera:
    """Camera in a Z-up frame."""
    return look_at(centre, size=SIZE, focal=70.0, name=name)


def photo_of_ball(camera: Camera, colour: int) -> tuple[np.ndarray, np.ndarray]:
    """Photo and mask of the ball in the unit frame by analytic ray–sphere intersection, 4 x 4 samples per pixel; random background."""
    fine = camera.scaled(4 * SIZE, 4 * SIZE)
    rays = fine.rays()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ -fine.centre
    hit = fine.centre @ fine.centre - along**2 < RADIUS**2
    share = hit.reshape(SIZE, 4, SIZE, 4).mean((1, 3))
    photo = np.where(share[..., None] > 0, colour, np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3)))
    return photo.astype(np.uint8), np.round(255 * share).astype(np.uint8)


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Finished]:
    def make(materials: bool = False, masks: bool = True, holdout: int = 4, shift: float = 0.0) -> Finished:
        root = tmp_path / "run"
        folders = {s: root / s for s in ("ingest", "poses", "train", "refine", "mesh", "bake", "export")}
        for k, (stage, folder) in enumerate(folders.items()):
            folder.mkdir(parents=True)
            manifest = {
                "stage": stage, "title": f"Stage {stage}", "seconds": 1.5 * (k + 1), "parts": {"first": 1.0, "second": 0.5},
                "peak_bytes": 1e8 * (k + 1), "results": {"figure": k, "nested": {"a": 1.25}}, "settings": {f"{stage}.size": 3},
                "threads": 2, "host": {"cpu": "A CPU", "cores": 2},
                "decisions": [DECISION] if stage == "poses" else [],
                "warnings": ["One photo is blurred & dark."] if stage == "ingest" else [],
                "inputs": {"photos": {"path": "/data/grey_ball/images"}} if stage == "ingest" else {},
            }  # fmt: skip
            (folder / "manifest.json").write_text(json.dumps(manifest))
        # The unit frame is rotated, scaled and translated with respect to the world.
        turn = cv2.Rodrigues(np.array([0.3, -0.5, 0.9]))[0]
        to_world = Similarity(2.5, turn, np.array([0.4, -0.2, 1.1]))
        heights = np.linspace(-0.4, 0.8, VIEWS)
        centres = [2.4 * np.array([np.cos(i) * np.sqrt(1 - h * h), np.sin(i) * np.sqrt(1 - h * h), h]) for i, h in enumerate(heights)]
        cameras = tuple(look_at_origin(f"IMG_{i}.a", c) for i, c in enumerate(centres))
        CameraSet(cameras, to_world).save(folders["poses"] / "cameras.json")
        (folders["poses"] / "photos").mkdir()
        if masks:
            (folders["poses"] / "masks").mkdir()
        for camera in cameras:
            photo, mask = photo_of_ball(camera, 188)
            cv2.imwrite(str(folders["poses"] / "photos" / f"{camera.name}.png"), photo)
            if masks:
                cv2.imwrite(str(folders["poses"] / "masks" / f"{camera.name}.png"), mask)
        listed = [{"name": c.name} for c in cameras] + [{"name": "without pose"}]
        (folders["ingest"] / "photos.json").write_text(json.dumps({"photos": listed, "skipped": []}))
        rows = "step,psnr,surfels,sdf_median,gamma\n" + "".join(f"{100 * i},{20 + i},{500 + i},{0.1 / (i + 1)},{i + 1}\n" for i in range(5))
        (folders["train"] / "log.csv").write_text(rows)
        # The asset: the ball, unit → world → glTF.
        frame = to_world.then(Similarity(1.0, WORLD_TO_ASSET))
        shape = ball(RADIUS, rows=48)
        position = frame.apply(shape.position) + [shift, 0, 0]
        normal = shape.normal @ frame.rotation.T
        tangent = np.concatenate([np.cross(normal, [0.1, 0.2, 0.9]), np.ones((len(normal), 1))], 1)
        mesh = GltfMesh(*(a.astype(np.float32) for a in (position, normal, tangent, shape.uv)), shape.faces)
        grey = np.full((8, 8, 3), 188, np.uint8)
        orm = np.broadcast_to(np.uint8([0, 255, 255]), (8, 8, 3))  # BGR: metallic 0, roughness 1, occlusion 1
        flat = np.broadcast_to(np.uint8([255, 128, 128]), (8, 8, 3))
        data = build_glb(mesh, GltfTextures(png(grey), png(orm), png(flat)), "ball", "test")
        (folders["export"] / "asset.glb").write_bytes(data)
        frames = [
            {
                "file_path": f"{c.name}.JPG", "transform_matrix": c.moved(frame).camera_to_world_opengl().tolist(),
                "w": SIZE, "h": SIZE, "fl_x": 70.0, "fl_y": 70.0, "cx": SIZE / 2, "cy": SIZE / 2,
            }
            for c in cameras
        ]  # fmt: skip
        (folders["export"] / "cameras.json").write_text(json.dumps({"frames": frames}))
        if materials:
            EnvironmentLight.from_radiance(np.ones((6, 8, 8, 3), np.float32)).save(folders["bake"] / "light.safetensors")
        out = root / "report"
        out.mkdir()
        return Finished(folders, out, ReportOptions(Report(views=2, view_size=48), holdout))

    return make
