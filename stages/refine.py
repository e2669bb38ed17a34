"""Stage refine: pruning, densification and fine-tuning of the trained surfels."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage
from gsbake.surfels import KERNELS


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.surfels.training.run.refine_surfels`."""
    from gsbake.surfels.training.run import RefineOptions, refine_surfels
    from gsbake.surfels.training.session import TrainOptions

    s = ctx.settings
    training = TrainOptions(s.train, s.surfels, s.loss, converged_steps=s.skip.converged_steps, coupling=s.coupling)
    return refine_surfels(
        ctx.inputs["poses"], ctx.inputs["train"], ctx.out, RefineOptions(s.refine, training),
        seed=ctx.seed, threads=ctx.threads, device=ctx.device, scratch=ctx.checkpoint, monitor=ctx,
    )  # fmt: skip


STAGE = Stage(
    name="refine",
    version=4,
    title="Surfel refinement",
    run=run,
    summary="{surfels} surfels, {steps} steps, {psnr:dB} on validation photos",
    needs=("poses", "train"),
    settings=(
        "refine.*", "train.max_size", "train.holdout", "train.lr_*", "train.sharpness", "train.final_width", "surfels.*", "loss.*",
        "coupling.*", "skip.converged_steps",
    ),
    uses_device=True,
    seeded=True,
    kernels=lambda settings: KERNELS,
)  # fmt: skip
