"""Stage train: posed photos → trained surfels and light."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.skip import leave_out, wanted
from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """Start surfels, train them, and write `surfels.safetensors`, `light.safetensors` (materials only) and `log.csv`; where poses or
    exposures were refined also `cameras.json` or `exposure.json`."""
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.surfels.densification.policies import growth
    from gsbake.surfels.initialisation import begin
    from gsbake.surfels.training.session import Session
    from gsbake.surfels.training.step_budget import settled_share, settles, spared_steps

    settings = ctx.settings
    posed = PosedPhotos.open(ctx.inputs["poses"])
    with ctx.part("start"):
        surfels, kind, why = begin(posed, settings.train, settings.splat, ctx.seed, ctx.inputs["stereo"])
        ctx.decide("surfels start from", kind, why)
    rule, reason = growth(settings.train.densify, kind)
    ctx.decide("surfels multiply by", rule, reason)
    light = None
    if settings.splat.shading == "pbr":
        from gsbake.shading.environment import EnvironmentLight

        light = EnvironmentLight(settings.splat.env_size)
    else:
        ctx.decide("environment light", "skipped", "the profile asks for plain colours")
    share = settled_share(posed, ctx.inputs["stereo"])
    holds, evidence = settles(share, kind, light is not None)
    steps = settings.train.iterations
    trusted = 1.0 if settings.skip.settled == "always" else share
    spared = spared_steps(steps, trusted) if wanted(ctx, "settled", holds) else 0
    session = Session(ctx, posed, surfels, light, steps - spared, settings.train.coarse_share, rule)
    results = session.run()
    choice = f"{spared} of {steps} steps left out"
    leave_out(ctx, "settled", holds, evidence, choice, "no steps left out", spared * session.step_seconds)
    return results


STAGE = Stage(
    name="train",
    version=3,
    title="train surfels",
    run=run,
    needs=("poses", "stereo"),
    settings=("train.*", "splat.*", "loss.*", "skip.converged", "skip.settled", "skip.refined_*"),
    uses_device=True,
    seeded=True,
)
