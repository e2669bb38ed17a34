"""Stage train: posed photos → trained surfels and light."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """Start surfels, train them, and write `surfels.safetensors`, `light.safetensors` (materials only) and `log.csv`."""
    from gsbake.capture.posed import PosedPhotos
    from gsbake.splat.session import Session
    from gsbake.splat.start import begin

    settings = ctx.settings
    posed = PosedPhotos.open(ctx.inputs["poses"])
    with ctx.part("start"):
        surfels, kind, why = begin(posed, settings.train, settings.splat, ctx.seed, ctx.inputs["stereo"])
        ctx.decide("surfels start from", kind, why)
    light = None
    if settings.splat.shading == "pbr":
        from gsbake.light.environment import EnvironmentLight

        light = EnvironmentLight(settings.splat.env_size)
    else:
        ctx.decide("environment light", "skipped", "the profile asks for plain colours")
    session = Session(ctx, posed, surfels, light, settings.train.iterations, settings.train.coarse_share, densify=True)
    return session.run()


STAGE = Stage(
    name="train",
    version=1,
    title="train surfels",
    run=run,
    needs=("poses", "stereo"),
    settings=("train.*", "splat.*", "loss.*"),
    uses_device=True,
    seeded=True,
)
