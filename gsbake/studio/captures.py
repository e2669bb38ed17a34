"""The list of captures, with the figures that `gsbake batch` shows, and a new one."""

from __future__ import annotations

from typing import Any

from starlette.responses import FileResponse, Response

from gsbake.batch.captures import CapturePlan, states_of
from gsbake.batch.page import COLUMNS, Cell, figures_of
from gsbake.errors import GsbakeError
from gsbake.pipeline.engine import artifacts_by_stage
from gsbake.pipeline.uses import in_use
from gsbake.publish import published_results
from gsbake.studio.answers import Call
from gsbake.studio.images import SMALL
from gsbake.studio.live import LiveRun
from gsbake.studio.sessions import session_of
from gsbake.studio.workspace import Capture, NotFoundError


def listing(call: Call) -> dict[str, Any]:
    """Names and paths of the captures; what takes longer is asked for one by one."""
    found = call.workspace.captures()
    return {
        "folder": call.workspace.name, "grows": call.workspace.grows, "columns": COLUMNS,
        "captures": [{"name": capture.name, **_paths(capture)} for capture in found],
    }  # fmt: skip


def create(call: Call) -> dict[str, Any]:
    """Make a capture."""
    capture = call.workspace.create(call.field("name", str))
    return {"name": capture.name, **_paths(capture)}


def details(call: Call) -> dict[str, Any]:
    """State, message and figures of one capture."""
    capture = call.capture
    live = LiveRun.read(capture.out)
    message, left, total = "", 0, 0
    cells: tuple[Cell, ...] = ()
    try:
        session = session_of(capture)
        states = states_of(session)
        files = published_results(session.out, artifacts_by_stage(states), session.project)
        plan = CapturePlan(capture.name, capture.folder, capture.out, tuple(states), files=files)
        left, total, cells = len(plan.to_run), len(plan.states), figures_of(plan)
        state = "done" if plan.done else "unfinished" if left < total else "new"
    except GsbakeError as error:
        state, message = "empty" if not capture.photos() else "failed", str(error)
    if live is not None and live.runs:
        state, message = "running", live.summary
    elif in_use(capture.out):  # a job of a batch, which writes no live.json
        state = "running"
    elif live is not None and state == "unfinished" and live.document.get("exit_code") not in (0, None):
        state, message = "failed" if live.document.get("exit_code") != 75 else "unfinished", str(live.document.get("message", ""))
    return {
        "name": capture.name, "state": state, "message": message, "done": total - left, "stages": total, **_paths(capture),
        "cells": [{"text": cell.text, "value": cell.value} for cell in cells], "count": len(capture.photos()),
    }  # fmt: skip


def thumbnail(call: Call) -> Response:
    """The first photo, small."""
    capture = call.capture
    names = list(capture.photos())
    if not names:
        raise NotFoundError(f"{capture.name} has no photos yet.")
    shown = call.services.images.picture(capture, names[0], SMALL)
    return FileResponse(shown.file, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=60"})


def _paths(capture: Capture) -> dict[str, str]:
    """The paths of a capture as one types them."""
    return {"source": capture.shown(capture.source), "out": capture.shown(capture.out)}
