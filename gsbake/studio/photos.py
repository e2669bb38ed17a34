"""The contact sheet: the photos of a capture, what `gsbake check` found of each, and those that are left out."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from starlette.responses import FileResponse, Response

from gsbake.errors import BadInputError, GsbakeError
from gsbake.studio.answers import FOREVER, Call
from gsbake.studio.images import LARGE, SMALL
from gsbake.studio.outputs import entries, outputs
from gsbake.studio.sessions import session_of
from gsbake.studio.workspace import Capture


def listing(call: Call) -> dict[str, Any]:
    """The photos, each with what is known of it: by the last check, and by the stages ingest and poses."""
    capture = call.capture
    files = capture.photos()
    left_out, check = _left_out(capture), call.services.checks.state(capture)
    known: dict[str, dict[str, Any]] = {}
    for row in (check["found"] or {}).get("figures", {}).get("photos", []):
        if isinstance(row, dict):
            known[str(row.get("source"))] = row
    names = _not_registered(capture)
    photos = []
    for name, path in files.items():
        row = {key: known[name].get(key) for key in ("blurred", "blur", "exposure", "clipped", "duplicate_of", "registered", "skipped")
               } if name in known else {}  # fmt: skip
        if name in names:
            row["registered"] = False
        version = path.stat().st_mtime_ns
        photos.append({"name": name, "version": f"{version:x}", "left_out": name in left_out or path.name in left_out, **row})
    findings = (check["found"] or {}).get("findings", [])
    return {
        "photos": photos, "video": not files and capture.source.is_file(), "checking": check["running"], "error": check["error"],
        "checked": check["found"] is not None, "findings": findings if isinstance(findings, list) else [],
    }  # fmt: skip


def check(call: Call) -> dict[str, Any]:
    """Start a check."""
    if not call.capture.photos() and call.capture.source == call.capture.folder:
        raise BadInputError("There are no photos yet; add some.")
    call.services.checks.start(call.capture)
    return {"running": True}


def image(call: Call) -> Response:
    """A photo at a size of the page."""
    size = LARGE if call.query.get("size") == "large" else SMALL
    shown = call.services.images.picture(call.capture, call.path["photo"], size)
    return FileResponse(shown.file, headers=FOREVER, media_type="image/jpeg")


def _left_out(capture: Capture) -> frozenset[str]:
    with suppress(GsbakeError):
        return frozenset(session_of(capture).profile.profile.ingest.leave_out)
    return frozenset()


def _not_registered(capture: Capture) -> frozenset[str]:
    """Photos that the stage poses could not place."""
    found = outputs(capture)
    with suppress(OSError, ValueError, LookupError, TypeError):
        missing = set(found["poses"].results.get("not_registered") or ())
        return frozenset(entry["source"] for entry in entries(found["ingest"]) if entry["name"] in missing)
    return frozenset()
