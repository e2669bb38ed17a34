"""Stage stereo: posed photos → depth maps, oriented points and the carved visual hull."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.mvs.stereo.run_stereo`."""
    from gsbake.mvs.stereo import run_stereo

    return run_stereo(
        ctx.inputs["poses"], ctx.out, ctx.settings.stereo, ingest=ctx.inputs["ingest"], holdout=ctx.settings.train.holdout, seed=ctx.seed,
        threads=ctx.threads, scratch=ctx.checkpoint, monitor=ctx,
    )  # fmt: skip


#: Modules with the kernels of this stage.
KERNELS = (
    "gsbake.mvs.patchmatch", "gsbake.mvs.depth_bounds", "gsbake.capture.hull.softness", "gsbake.mvs.consistency", "gsbake.mvs.fusion",
    "gsbake.mvs.mirror_images", "gsbake.mvs.carving", "gsbake.shape_refinement.samples_kernel",
    "gsbake.shape_refinement.reflection_kernel", "gsbake.shape_refinement.surface",
)  # fmt: skip


STAGE = Stage(
    name="stereo",
    version=16,
    title="Multi-view stereo",
    run=run,
    summary="{points} points, {confirmed_share:%} of the object confirmed",
    needs=("ingest", "poses"),
    settings=("stereo.*", "train.holdout"),
    seeded=True,
    kernels=lambda settings: () if settings.stereo.enabled == "never" else KERNELS,
)
