"""The pipeline with its own declarations and stages that take no time: each writes small files with the names of its real output."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from gsbake.geometry.ply import write_mesh
from gsbake.imaging.png import write_png
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Context
from gsbake.stages import ORDER
from gsbake.stages import REGISTRY as REAL

#: What `gsbake masks` reads: one photo with an automatic mask.
PHOTOS = {"photos": [{"name": "a", "source": "a.jpg", "source_width": 8, "source_height": 6, "mask": None}], "skipped": []}

#: The dense mesh, which a low-poly one is compared with.
BALL = trimesh.creation.icosphere(subdivisions=2)
#: What each stage writes.
FILES = {
    "ingest": ("photos.json",),
    "poses": ("cameras.json", "points.ply", "photo_masks/a.png"),
    "stereo": ("points.ply",),
    "train": ("surfels.safetensors",),
    "refine": ("surfels.safetensors",),
    "mesh": ("dense.ply", "mesh.ply"),
    "bake": ("mesh.safetensors", "base_color.exr"),
    "export": ("asset.glb", "cameras.json", "light.hdr"),
    "report": ("report.html",),
    "targets": ("asset_web.glb", "targets.json"),
}
#: Figures of the stages whose figures commands read.
RESULTS: dict[str, dict[str, Any]] = {
    "poses": {"doubtful_masks": ["a"]},
    "report": {"psnr": 25.0, "ssim": 0.9, "bytes": 10**6, "compared": 1},
}


def _toy(name: str) -> Callable[[Context], dict[str, Any]]:
    def run(ctx: Context) -> dict[str, Any]:
        for file in FILES[name]:
            head = "ply\n" if file.endswith(".ply") else ""
            (ctx.out / file).parent.mkdir(exist_ok=True)
            if file == "photos.json":
                (ctx.out / file).write_text(json.dumps(PHOTOS))
            elif file == "dense.ply":
                write_mesh(ctx.out / file, BALL.vertices, BALL.faces)
            elif file.endswith(".png"):
                write_png(ctx.out / file, np.full((6, 8), 255, np.uint8))
            else:
                (ctx.out / file).write_text(f"{head}{name} {file}")
        return RESULTS.get(name, {})

    return run


STAGES = {name: replace(REAL.load(name), run=_toy(name), summary="") for name in ORDER}
INGEST, POSES, STEREO, TRAIN, REFINE, MESH, BAKE, EXPORT, REPORT, TARGETS = (STAGES[name] for name in ORDER)
REGISTRY = Registry({name: f"tests.docs.toy_stages:{name.upper()}" for name in ORDER})
