"""Toy stages of a batch that is interrupted: the mesh is interrupted at its first attempt, and slow where a photo says so."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from gsbake.errors import InterruptedRun
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Context
from tests.cli import toy_bake


def _mesh(ctx: Context) -> dict[str, Any]:
    text = (ctx.inputs["ingest"] / "photos.json").read_text()
    attempts = ctx.checkpoint / "attempts.txt"
    attempt = len(attempts.read_text()) if attempts.exists() else 0
    attempts.write_text("x" * (attempt + 1))
    if "flaky" in text and attempt == 0:
        raise InterruptedRun("The power failed.")
    if "slow" in text and attempt == 0:
        for step in range(600):
            time.sleep(0.1)
            ctx.progress(step, 600)
    (ctx.out / "mesh.ply").write_text("ply")
    (ctx.out / "dense.ply").write_text("ply")
    return {"attempts": attempt + 1}


MESH = replace(toy_bake.MESH, run=_mesh)
REGISTRY = Registry({**toy_bake.REGISTRY.references, "mesh": "tests.batch.flaky:MESH"})
