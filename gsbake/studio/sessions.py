"""The next run of a capture: what its output folder stores, and what is found in the capture now."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsbake.api import RunOptions, Session, open_session
from gsbake.config.load import DEFAULT
from gsbake.studio.workspace import Capture


def session_of(
    capture: Capture, given: Mapping[str, Any] | None = None, unset: frozenset[str] = frozenset(), profile: str | None = None
) -> Session:
    """The next run of a capture: the stored options, with the `given` settings and without those that `unset` names.

    Photos, masks and poses are looked for again, as the capture may have got masks. Raises as `open_session`.
    """
    stored = capture.project
    overrides = [text for text in (stored.overrides if stored else ()) if text.partition("=")[0].strip() not in unset]
    overrides += [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in (given or {}).items()]
    last = {text.partition("=")[0].strip(): text for text in overrides}
    name = profile or (stored.profile if stored else None) or DEFAULT
    masks, poses = (_elsewhere(capture, path) for path in ((stored.masks, stored.poses) if stored else (None, None)))
    return open_session(
        RunOptions(capture.source, capture.out, name, list(last.values()), masks, poses, seed=stored.seed if stored else None)
    )


def _elsewhere(capture: Capture, path: str | None) -> Path | None:
    """A stored path that lies outside the capture, and so is not found again by itself."""
    if path is None or Path(path).is_relative_to(capture.folder) or not Path(path).exists():
        return None
    return Path(path)


def values(session: Session) -> dict[str, Any]:
    """{"section.key": value} of the settings that the session overrides."""
    body = session.profile.profile.model_dump(mode="json")
    keys = [key for key, origin in session.profile.origins.items() if origin == "--set" and "." in key]
    return {key: body[key.partition(".")[0]][key.partition(".")[2]] for key in keys}
