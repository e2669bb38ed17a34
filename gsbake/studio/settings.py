"""The settings of a capture's next run: read from and stored in its output folder, as `gsbake settings` does, and described for a form."""

from __future__ import annotations

from functools import cache
from typing import Any, get_args, get_origin

from gsbake.config.load import DEFAULT, bounds, fields, load_profile, shipped
from gsbake.errors import UsageError
from gsbake.studio.answers import Call
from gsbake.studio.sessions import session_of, values

#: Settings that matter most, in the order of the form.
FIRST = (
    "bake.materials", "bake.size", "mesh.faces", "mesh.max_resolution", "ingest.max_size", "ingest.masks", "poses.matching",
    "stereo.enabled", "train.iterations", "train.max_size", "export.max_megabytes", "targets.levels",
)  # fmt: skip
#: Settings that other tabs show.
ELSEWHERE = frozenset({
    "ingest.leave_out", "poses.region", "poses.region_box", "scale.known_distances", "export.up", "export.up_points", "export.front",
    "export.origin", "bake.white", "targets.files",
})  # fmt: skip


def stored(call: Call) -> dict[str, Any]:
    """Profile and settings of the capture's next run."""
    capture = call.capture
    session = session_of(capture)
    return {"profile": session.profile.name, "settings": values(session), "stored": capture.project is not None}


def asked(call: Call) -> tuple[dict[str, Any], frozenset[str], str | None]:
    """The settings that a request gives and unsets, and its profile: {"profile": name, "set": {key: value}, "unset": [key]}, each of
    which may be missing. Raises UsageError, also for a profile that is not one of gsbake's own."""
    body = call.body if isinstance(call.body, dict) else {}
    given, unset, profile = body.get("set", {}), body.get("unset", []), body.get("profile")
    if not isinstance(given, dict) or not isinstance(unset, list) or not isinstance(profile, str | None):
        raise UsageError("Settings are changed by 'set' and 'unset'.")
    if profile is not None and profile not in shipped():
        raise UsageError(f"There is no profile '{profile[:80]}'.")
    return {str(key): value for key, value in given.items()}, frozenset(map(str, unset)), profile


def change(call: Call) -> dict[str, Any]:
    """Store the settings that are asked for."""
    given, unset, profile = asked(call)
    if not given and not unset and profile is None:
        return stored(call)
    session = session_of(call.capture, given, unset, profile)
    session.store_settings()
    return {"profile": session.profile.name, "settings": values(session), "stored": True}


def form(call: Call) -> dict[str, Any]:
    """All settings for a form, with their values in a profile: kind, choices and limits as the schema has them, and its help."""
    name = call.query.get("profile", DEFAULT)
    if name not in shipped():
        raise UsageError(f"There is no profile '{name[:80]}'.")
    loaded = load_profile(name)
    body = loaded.profile.model_dump(mode="json")
    found = []
    for key, field in fields().items():
        section, dot, inner = key.partition(".")
        if dot:
            found.append({
                "key": key, "value": body[section][inner], "help": field.description, "allowed": bounds(field), **_kind(field),
                "first": FIRST.index(key) if key in FIRST else None, "elsewhere": key in ELSEWHERE,
            })  # fmt: skip
    return {"profile": name, "default": DEFAULT, "profiles": _profiles(), "settings": found}


@cache
def _profiles() -> dict[str, str]:
    """{name: what it is for} of the profiles for assets."""
    loaded = {name: load_profile(name).profile for name in shipped()}
    return {name: profile.description for name, profile in loaded.items() if profile.group == "assets"}


def _kind(field: Any) -> dict[str, Any]:
    """How a form asks for a field: choices, a switch, a number with limits, a list or text."""
    kind = field.annotation
    if kind is bool:
        return {"kind": "switch"}
    if get_origin(kind) is tuple:
        return {"kind": "list", "numbers": float in get_args(kind)}
    if choices := [word for c in get_args(kind) for word in ((True, False) if c is bool else get_args(c) or (c,))]:
        return {"kind": "choice", "choices": choices}
    limits = {name: getattr(m, name) for m in field.metadata for name in ("ge", "gt", "le") if hasattr(m, name)}
    if limits:
        return {"kind": "number", "whole": kind is int, "least": limits.get("ge", limits.get("gt")), "most": limits.get("le")}
    return {"kind": "text"}
