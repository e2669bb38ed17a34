"""Stage poses: working photos → cameras, pinhole photos and the unit frame."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.capture.estimate_poses.estimate_poses`."""
    from gsbake.capture.estimate_poses import PoseOptions, estimate_poses

    options = PoseOptions(ctx.settings.poses, ctx.settings.skip.redundant_photos)
    return estimate_poses(
        ctx.inputs["ingest"], ctx.out, options,
        seed=ctx.seed, threads=ctx.threads, scratch=ctx.checkpoint, cache=ctx.cache, monitor=ctx,
    )  # fmt: skip


#: Modules with the kernels of this stage.
KERNELS = (
    "gsbake.capture.hull.visual_hull", "gsbake.capture.sfm.matching", "gsbake.capture.sfm.patch_alignment",
    "gsbake.capture.hull.ray_distance",
)  # fmt: skip


STAGE = Stage(
    name="poses",
    version=18,
    title="Camera poses",
    run=run,
    summary="{registered} photos registered, {points} tie points, {reprojection_px:px} reprojection error",
    needs=("ingest",),
    settings=("poses.*", "skip.redundant_photos"),
    seeded=True,
    kernels=lambda settings: KERNELS,
)
