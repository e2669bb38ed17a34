"""`gsbake run` and the stage commands: bring the pipeline up to a stage."""

from __future__ import annotations

import json
from typing import Any

import typer

from gsbake.cli.display import choose_display, close_display
from gsbake.cli.inspect import plan_document, print_plan
from gsbake.cli.options import Options
from gsbake.cli.publish import publish_results
from gsbake.cli.session import open_session
from gsbake.errors import BadInputError
from gsbake.pipeline.engine import artifacts_of
from gsbake.pipeline.files import disk_error, open_output
from gsbake.pipeline.plan import StageState
from gsbake.text import duration


def run_pipeline(options: Options, target: str | None) -> None:
    """Run up to `target` (everything without one) and say where the results are."""
    import time

    start = time.perf_counter()
    display = choose_display(quiet=options.quiet, as_json=options.as_json)
    session = open_session(options, display)
    if options.dry_run:
        states = session.engine.plan(target)
        if options.as_json:
            typer.echo(json.dumps(plan_document(session, states), indent=1, ensure_ascii=False))
        elif not options.quiet:
            print_plan(states)
        return
    try:
        open_output(session.out)
        session.project.save(session.out)
        states = session.engine.run(target)
        placed, project = publish_results(session.out, artifacts_of(states), session.project, session.engine.store.digests)
        project.save(session.out)
        session.engine.store.digests.save()
    except OSError as error:
        raise disk_error(error, session.out) or BadInputError(
            f"The output folder '{session.out}' cannot be written ({error.strerror}); choose another with --out."
        ) from error
    finally:
        close_display(display)
    seconds = time.perf_counter() - start
    if options.as_json:
        document = {
            "out": str(session.out),
            "seconds": round(seconds, 3),
            "stages": [_document(state) for state in states],
            "files": {name: str(path) for name, path in placed.items()},
            "exit_code": 0,
        }
        typer.echo(json.dumps(document, indent=1, ensure_ascii=False))
    elif not options.quiet:
        last = states[-1].artifact
        found = [str(path) for path in placed.values()] or ([str(last.folder)] if last is not None else [])
        typer.echo(f"Done in {duration(seconds)}: {', '.join(found)}")


def _document(state: StageState) -> dict[str, Any]:
    manifest = state.artifact.manifest if state.artifact is not None else {}
    ran = state.status == "run"
    return {
        "name": state.name,
        "status": "ran" if ran else state.status,
        "reasons": list(state.reasons),
        "folder": str(state.artifact.folder) if state.artifact is not None else None,
        "seconds": manifest.get("seconds"),
        "peak_bytes": manifest.get("peak_bytes"),
        "results": manifest.get("results", {}),
        "decisions": manifest.get("decisions", []),
        "warnings": manifest.get("warnings", []),
    }
