"""Stage refine: SDF-guided pruning and densifying of the trained surfels, then a short fine-tune."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """Prune, densify and fine-tune; writes the same files as train and reports the counts before and after."""
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.surfels.densification.refinement import prune_and_densify
    from gsbake.surfels.model import Surfels
    from gsbake.surfels.training.session import Session

    settings = ctx.settings
    posed = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["train"])
    surfels = Surfels.load(ctx.inputs["train"] / "surfels.safetensors")
    light = None
    if (ctx.inputs["train"] / "light.safetensors").exists():
        from gsbake.shading.environment import EnvironmentLight

        light = EnvironmentLight.load(ctx.inputs["train"] / "light.safetensors")
    with ctx.part("prune and densify"):
        surfels, counts = prune_and_densify(surfels, posed, settings.refine, settings.train.max_size, ctx.seed)
    session = Session(ctx, posed, surfels, light, settings.refine.iterations, 0.0, None, ctx.inputs["train"])
    return session.run() | {"counts": counts}


STAGE = Stage(
    name="refine",
    version=2,
    title="refine surfels",
    run=run,
    needs=("poses", "train"),
    settings=("refine.*", "train.max_size", "train.holdout", "train.lr_*", "splat.*", "loss.*", "skip.converged"),
    uses_device=True,
    seeded=True,
)
