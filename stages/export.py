"""Stage export: textures and mesh → the asset and the files beside it."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.gltf.export.export_asset`."""
    from gsbake.gltf.export import ExportOptions, export_asset

    options = ExportOptions(ctx.settings.export, ctx.settings.bake.materials, ctx.settings.scale)
    inputs = ctx.inputs
    return export_asset(inputs["ingest"], inputs["poses"], inputs["refine"], inputs["bake"], ctx.out, options, monitor=ctx)


STAGE = Stage(
    name="export",
    version=6,
    title="Asset",
    run=run,
    summary="{megabytes:MB}, {triangles} triangles, {texture_size}² texels",
    needs=("ingest", "poses", "refine", "bake"),
    settings=("export.*", "scale.*", "bake.materials", "bake.size"),  # the last for the estimate
)
