"""Stage train: posed photos → trained surfels and light."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage
from gsbake.surfels import KERNELS


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.surfels.training.run.train_surfels`."""
    from gsbake.surfels.training.run import train_surfels
    from gsbake.surfels.training.session import TrainOptions

    s = ctx.settings
    rules = s.skip.confirmed_steps, s.skip.converged_steps, s.skip.pose_refinement, s.skip.exposure_refinement
    options = TrainOptions(s.train, s.surfels, s.loss, s.light.size, *rules, field=s.field, coupling=s.coupling)
    return train_surfels(
        ctx.inputs["poses"], ctx.out, options, stereo=ctx.inputs["stereo"], priors=(ctx.inputs.get("normals"), ctx.inputs.get("depths")),
        seed=ctx.seed, threads=ctx.threads, device=ctx.device, scratch=ctx.checkpoint, monitor=ctx,
    )  # fmt: skip


STAGE = Stage(
    name="train",
    version=12,
    title="Surfel training",
    run=run,
    summary="{surfels} surfels, {steps} steps, {psnr:dB} on validation photos",
    needs=("poses", "stereo"),
    sources=("normals", "depths"),
    settings=(
        "train.*", "surfels.*", "light.*", "loss.*", "field.*", "coupling.*", "skip.converged_steps", "skip.confirmed_steps",
        "skip.*_refinement",
    ),
    uses_device=True,
    seeded=True,
    kernels=lambda settings: KERNELS,
)  # fmt: skip
