"""Stage bake: mesh and photos → textures, materials and light."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.materials.bake.bake_textures`."""
    from gsbake.materials.bake import BakeOptions, bake_textures

    options = BakeOptions.of(ctx.settings)
    poses, surfels, mesh = ctx.inputs["poses"], ctx.inputs["refine"], ctx.inputs["mesh"]
    return bake_textures(poses, surfels, mesh, ctx.out, options, seed=ctx.seed, threads=ctx.threads, monitor=ctx)


STAGE = Stage(
    name="bake",
    version=45,
    title="Textures",
    run=run,
    summary="{charts} charts, {texels} texels, {fit_psnr:dB} on test photos",
    needs=("poses", "refine", "mesh"),
    settings=(
        "bake.*", "light.size", "train.max_size", "train.holdout", "skip.exposure_equalisation", "skip.normal_map", "skip.specular",
        "skip.metallic_map", "skip.roughness_map",
    ),
    uses_device=True,
    seeded=True,
)  # fmt: skip
