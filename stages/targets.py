"""Stage targets: the baked asset → files for the places where it is used, within their budgets."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.targets.build.build_targets`."""
    from gsbake.targets.build import TargetOptions, build_targets

    s = ctx.settings
    options = TargetOptions(s.targets, s.export, s.mesh.decimator, ctx.threads)
    return build_targets(ctx.inputs, ctx.out, options, monitor=ctx)


STAGE = Stage(
    name="targets",
    version=6,
    title="Targets",
    run=run,
    summary="{files} files",
    needs=("ingest", "poses", "refine", "mesh", "bake", "export"),
    settings=("targets.*", "export.*", "mesh.decimator"),
)
