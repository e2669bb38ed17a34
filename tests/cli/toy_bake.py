"""Toy pipeline with gsbake's stage names and results for tests of the command line."""

from __future__ import annotations

import os
import time
from typing import Any

from gsbake.errors import BadInputError
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Context, Stage

#: Names that no target's file has.
FOREIGN_NAMES = (".envrc", ".git/hooks/post-checkout", "project.json", "stages/planted", "asset.glb", "notes.txt", "asset_film/.envrc")


def _ingest(ctx: Context) -> dict[str, Any]:
    folder = ctx.inputs["photos"]
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    if len(names) < ctx.settings.ingest.min_photos:
        raise BadInputError(f"There are {len(names)} photos; give more.")
    text = "\n".join(names) + str("masks" in ctx.inputs) + str(ctx.settings.ingest.invert_masks)
    (ctx.out / "photos.json").write_bytes(os.fsencode(text))
    ctx.warn("photo 3 is blurred")
    for k, name in enumerate(names):
        ctx.progress(k + 1, len(names), name)
        if len(name) > 10:
            ctx.warn(f"the name {name} is long")
            ctx.decide("name", name, f"of {name}")
    ctx.decide("skip.redundant_photos", "all used", "none twice")
    return {"photos": len(names)}


def _mesh(ctx: Context) -> dict[str, Any]:
    for step in range(3):
        ctx.progress(step + 1, 3, psnr=20.0 + step)
        time.sleep(0.01)
    for name in ("mesh.ply", "dense.ply"):
        (ctx.out / name).write_text(f"ply {ctx.settings.mesh.faces}")
    return {"faces": ctx.settings.mesh.faces}


def _export(ctx: Context) -> dict[str, Any]:
    mesh = (ctx.inputs["mesh"] / "mesh.ply").read_text()
    (ctx.out / "asset.glb").write_text("glb " + mesh)
    (ctx.out / "cameras.json").write_text("{}")
    if ctx.settings.bake.materials != "none":
        (ctx.out / "light.hdr").write_text("light")
    return {"megabytes": 1.5}


def _report(ctx: Context) -> dict[str, Any]:
    if (ctx.inputs["export"] / "asset.glb").read_text().endswith(" 666"):
        raise BadInputError("There is no report on such a mesh.")
    (ctx.out / "report.html").write_text("<html>")
    return {"psnr": 21.5, "ssim": 0.9, "exposed_psnr": None, "compared": 3, "bytes": 10**6}


def _targets(ctx: Context) -> dict[str, Any]:
    """Files of targets, and such as only an output from outside holds."""
    for name in ("asset_web.glb", "asset_film/base_color.exr", *FOREIGN_NAMES):
        (ctx.out / name).parent.mkdir(parents=True, exist_ok=True)
        (ctx.out / name).write_text("from the targets")
    return {}


INGEST = Stage(
    "ingest", 1, "Reading photos", _ingest, sources=("photos", "masks", "poses"), settings=("ingest.min_photos", "ingest.invert_masks")
)
MESH = Stage("mesh", 1, "Meshing", _mesh, needs=("ingest",), settings=("mesh.faces",))
EXPORT = Stage("export", 1, "Exporting", _export, needs=("mesh",), settings=("bake.materials",))
REPORT = Stage("report", 1, "Reporting", _report, needs=("export",))

TARGETS = Stage("targets", 1, "Targets", _targets, needs=("export",), settings=("targets.files",))

REGISTRY = Registry({name: f"tests.cli.toy_bake:{name.upper()}" for name in ("ingest", "mesh", "export", "report")})
#: The same with the files of targets.
WITH_TARGETS = Registry({**REGISTRY.references, "targets": "tests.cli.toy_bake:TARGETS"})
