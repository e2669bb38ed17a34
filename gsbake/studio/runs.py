"""Runs as the command line sees them: what one would do and take, started, watched and stopped."""

from __future__ import annotations

from typing import Any

from starlette.responses import Response

from gsbake.batch.captures import states_of
from gsbake.errors import GsbakeError, UsageError
from gsbake.pipeline.machine import default_threads
from gsbake.stages import REGISTRY
from gsbake.studio.answers import Call
from gsbake.studio.sessions import session_of
from gsbake.studio.settings import asked
from gsbake.timing.expectations import Expectations


def plan(call: Call) -> dict[str, Any]:
    """The stages of the next run, with settings as `settings.change` takes them: state, reasons, seconds, memory."""
    session = session_of(call.capture, *asked(call))
    states = states_of(session)
    expected = Expectations(session.engine.request, session.engine.registry.names)
    stages, seconds, memory = [], 0.0, 0
    for state in states:
        estimate = expected.of(state) if state.artifact is None else None
        if estimate is not None:
            seconds, memory = seconds + estimate.seconds, max(memory, estimate.memory_mb)
        stages.append({
            "name": state.name, "title": state.title, "status": state.status, "reasons": list(state.reasons),
            "seconds": None if estimate is None else estimate.seconds,
        })  # fmt: skip
    return {"stages": stages, "seconds": seconds, "memory": 1e6 * memory, "threads": default_threads()}


def start(call: Call) -> dict[str, Any]:
    """Start a run up to a stage, or to the end."""
    until = call.body.get("until") if isinstance(call.body, dict) else None
    if until is not None and until not in REGISTRY.names:
        raise UsageError("There is no such stage.")
    session = session_of(call.capture)
    session.store_settings()
    call.services.runs.start(call.capture, until)
    return {"started": True}


def stop(call: Call) -> dict[str, Any]:
    """Stop the run."""
    call.services.runs.stop(call.capture)
    return {"stopping": True}


def state(call: Call) -> dict[str, Any]:
    """The run so far."""
    return call.services.runs.state(call.capture)


def picture(call: Call) -> Response:
    """The present picture."""
    try:
        return Response(call.services.runs.picture(call.capture), media_type="image/jpeg")
    except GsbakeError:
        return Response(status_code=204)
