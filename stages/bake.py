"""Stage bake: mesh and photos → textures, materials and light."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.materials.bake.bake_textures`."""
    from gsbake.materials.bake import BakeOptions, bake_textures

    options = BakeOptions.of(ctx.settings)
    ingest, poses, surfels, mesh = (ctx.inputs[name] for name in ("ingest", "poses", "refine", "mesh"))
    return bake_textures(ingest, poses, surfels, mesh, ctx.out, options, seed=ctx.seed, threads=ctx.threads, monitor=ctx)


#: Modules with the kernels of this stage, and with those of the material fit.
KERNELS = (
    "gsbake.texturing.texels", "gsbake.texturing.packing", "gsbake.texturing.ambient_occlusion", "gsbake.texturing.gather_kernel",
    "gsbake.texturing.view_fusion",
)  # fmt: skip
FIT_KERNELS = (
    "gsbake.materials.visibility", "gsbake.materials.fit_kernel", "gsbake.materials.adam_kernel", "gsbake.materials.linear_shading",
    "gsbake.materials.metallic", "gsbake.materials.remaining_shading",
)  # fmt: skip


STAGE = Stage(
    name="bake",
    version=66,
    title="Textures",
    run=run,
    summary="{charts} charts, {texels} texels, {fit_psnr:dB} on test photos",
    needs=("ingest", "poses", "refine", "mesh"),
    settings=(
        "bake.*", "light.size", "train.max_size", "train.holdout", "export.max_triangles", "skip.exposure_equalisation", "skip.normal_map",
        "skip.specular", "skip.metallic_map", "skip.roughness_map",
    ),
    uses_device=True,
    seeded=True,
    kernels=lambda settings: KERNELS + FIT_KERNELS if settings.bake.materials == "fit" else KERNELS,
)  # fmt: skip
