"""`gsbake run` and the stage commands."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsbake.api import Result, Session
from gsbake.cli.display import choose_display, close_display
from gsbake.cli.gates import REPORTED, check_bounds, end_at_gate, gate_document
from gsbake.cli.inspect import plan_document, print_plan
from gsbake.cli.kernels import compiling
from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_text
from gsbake.errors import GsbakeError, UsageError
from gsbake.pipeline.plan import StageState
from gsbake.studio.live import LiveState
from gsbake.text import duration, number, size
from gsbake.timing.expectations import Expectations


def run_pipeline(options: Options, until: str | None) -> None:
    """Bring the stages up to `until` (None: all) up to date and print a summary."""
    if options.require and until not in (None, "report"):
        raise UsageError("--require checks the report's figures: use it with `gsbake run` or `gsbake report`.")
    start = time.perf_counter()
    display = choose_display(quiet=options.quiet, verbose=options.verbose, as_json=options.as_json)
    session = options.session(display)
    expectations = Expectations(session.engine.request, session.engine.registry.names)
    display.expected = expectations.of
    if options.dry_run:
        states = session.engine.plan(until)
        if options.as_json:
            print_json(plan_document(session, states))
        elif not options.quiet:
            print_plan(states)
        return
    state = session.engine.observer = LiveState(display, session.out)
    state.expected = expectations.of
    try:
        with recorded(state), compiling(session, until, display), serving(session, options.view):
            result = session.run(until)
    finally:
        close_display(display)
    seconds = time.perf_counter() - start
    worse = check_bounds(options.require, result.results("report"), REPORTED) if options.require else []
    if options.as_json:
        print_json(_document(result, seconds) | gate_document(worse))
    elif not options.quiet:
        for name, text in summary_lines(result, seconds):
            print_text(f"{name:<9} {text}")
    end_at_gate(worse)


@contextmanager
def recorded(state: LiveState) -> Iterator[None]:
    """Record how the run ends."""
    try:
        yield
    except GsbakeError as error:
        state.end(error.exit_code, str(error))
        raise
    except BaseException as error:
        state.end(1, f"{type(error).__name__}: {error}")
        raise
    state.end(0)


@contextmanager
def serving(session: Session, view: bool) -> Iterator[None]:
    """With `view`, serve the studio for this run alone while it lasts; its address goes to stderr."""
    if not view:
        yield
        return
    from gsbake.studio.server import Studio
    from gsbake.studio.workspace import OneRun

    assert session.project.photos is not None
    one = OneRun.of(Path(session.project.photos), session.out)
    with Studio(one, run=one.name) as studio:
        print_text(f"Live view: {studio.address}", error=True)
        yield


def summary_lines(result: Result, seconds: float) -> list[tuple[str, str]]:
    """Summary lines (name, text) of a run: asset, size, image metrics, warnings, report and time, as far as they exist."""
    lines = []
    figures = {state.name: state.artifact.manifest.get("results", {}) for state in result.stages if state.artifact is not None}
    asset, export, report = result.files.get("asset.glb"), figures.get("export", {}), figures.get("report", {})
    if asset is not None:
        texture = f", {export['texture_size']}² texels" if "texture_size" in export else ""
        triangles = f", {number(export['triangles'])} triangles" if "triangles" in export else ""
        lines.append(("Asset", f"{asset}  ({size(asset.stat().st_size)}{triangles}{texture})"))
    elif result.stages and result.stages[-1].artifact is not None:
        lines.append(("Output", str(result.stages[-1].artifact.folder)))
    if "size_metres" in export:
        edges = " × ".join(f"{edge:.4g}" for edge in export["size_metres"])
        lines.append(("Size", f"{edges} m (± {100 * export['scale_relative_error']:.2g} %)"))
    if report.get("psnr") is not None:
        photos = "test photos" if report.get("held_out") else "training photos"
        equalised = report.get("exposed_psnr") or 0.0
        exposed = f", {equalised:.1f} dB with the exposure of each photo" if equalised > report["psnr"] + 1 else ""
        lines.append(("Quality", f"{report['psnr']:.1f} dB PSNR{exposed}, SSIM {report['ssim']:.3f} on {report['compared']} {photos}"))
    if result.warnings:
        lines.append(("Warnings", f"{len(result.warnings)}, listed above and in the report"))
    if "report.html" in result.files:
        lines.append(("Report", str(result.files["report.html"])))
    lines.append(("Time", duration(seconds)))
    return lines


def _document(result: Result, seconds: float) -> dict[str, Any]:
    """The run as JSON."""
    return {
        "out": str(result.out),
        "seconds": round(seconds, 3),
        "stages": [_stage(state) for state in result.stages],
        "files": {name: str(path) for name, path in result.files.items()},
    }


def _stage(state: StageState) -> dict[str, Any]:
    manifest = state.artifact.manifest if state.artifact is not None else {}
    return {
        "name": state.name,
        "status": "ran" if state.status == "run" else state.status,
        "reasons": list(state.reasons),
        "folder": str(state.artifact.folder) if state.artifact is not None else None,
        "seconds": manifest.get("seconds"),
        "peak_bytes": manifest.get("peak_bytes"),
        "results": manifest.get("results", {}),
        "decisions": manifest.get("decisions", []),
        "warnings": manifest.get("warnings", []),
    }
