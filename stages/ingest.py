"""Stage ingest: photos, masks and known poses → upright working photos."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.capture.ingest.ingest`."""
    from gsbake.capture.ingest import IngestOptions, ingest

    options = IngestOptions(ctx.settings.ingest, ctx.settings.skip.resolution)
    masks, poses = ctx.inputs.get("masks"), ctx.inputs.get("poses")
    return ingest(ctx.inputs["photos"], ctx.out, options, masks=masks, poses=poses, threads=ctx.threads, monitor=ctx)


STAGE = Stage(
    name="ingest",
    version=10,
    title="Photos",
    run=run,
    summary="{photos} photos, {masks} masks, {skipped} skipped",
    sources=("photos", "masks", "poses"),
    settings=("ingest.*", "skip.resolution"),
)
