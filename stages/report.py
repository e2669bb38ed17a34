"""Stage report: finished run → HTML page and its figures."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.report.write.write_report`."""
    from gsbake.report.write import ReportOptions, write_report

    options = ReportOptions(ctx.settings.report, ctx.settings.train.holdout)
    return write_report(ctx.inputs, ctx.out, options, threads=ctx.threads, monitor=ctx)


STAGE = Stage(
    name="report",
    version=13,
    title="Report",
    run=run,
    summary="{psnr:dB} and SSIM {ssim} over {compared} photos",
    needs=("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export"),
    settings=("report.*", "train.holdout"),
)
