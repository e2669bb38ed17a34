"""The event log: one JSON object a line, appended in single writes so that runs side by side do not tear each other's lines."""

from __future__ import annotations

import json
import os
import uuid
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


def now() -> str:
    """The time as ISO 8601 in UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class EventLog:
    """Appends to OUT/events.jsonl; each run has an id of its own."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.run = uuid.uuid4().hex[:8]

    def write(self, event: str, **fields: Any) -> None:
        """Append one event; the log must never be what ends a run, so a full disk is passed over."""
        line = json.dumps({"time": now(), "run": self.run, "event": event, **fields}, ensure_ascii=False, default=str) + "\n"
        with suppress(OSError):
            handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                os.write(handle, line.encode())
            finally:
                os.close(handle)
