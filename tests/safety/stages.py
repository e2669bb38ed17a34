"""Toy stages for the commands of the safety tests: those of the command line's tests, with photos that have masks, and poses."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from gsbake.imaging.png import write_png
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Context, Stage
from tests.cli import toy_bake


def _ingest(ctx: Context) -> dict[str, Any]:
    names = sorted(path.name for path in ctx.inputs["photos"].iterdir() if path.is_file())
    photos = [{"name": str(k), "source": name, "mask": f"{k}.png", "source_width": 4, "source_height": 4} for k, name in enumerate(names)]
    for photo in photos:
        write_png(ctx.out / str(photo["mask"]), np.zeros((4, 4), np.uint8))
    (ctx.out / "photos.json").write_text(json.dumps({"photos": photos}))
    return {"photos": len(names)}


def _poses(ctx: Context) -> dict[str, Any]:
    (ctx.out / "cameras.json").write_text("{}")
    return {}


INGEST = Stage("ingest", 1, "Reading photos", _ingest, sources=("photos", "masks", "poses"))
POSES = Stage("poses", 1, "Estimating poses", _poses, needs=("ingest",))

_TOY = toy_bake.REGISTRY.references
REGISTRY = Registry(
    {"ingest": "tests.safety.stages:INGEST", "poses": "tests.safety.stages:POSES", **{k: v for k, v in _TOY.items() if k != "ingest"}}
)
