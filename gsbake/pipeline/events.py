"""Event log in JSON Lines, appended in single writes so that lines of concurrent runs do not mix."""

from __future__ import annotations

import json
import uuid
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


def now() -> str:
    """Current time as ISO 8601 in UTC with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class EventLog:
    """Appends to OUT/events.jsonl; each run has its own id."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.run = uuid.uuid4().hex[:8]

    def write(self, event: str, **fields: Any) -> None:
        """Append one event. Write errors are ignored, so that logging cannot end a run."""
        line = json.dumps({"time": now(), "run": self.run, "event": event, **fields}, default=str) + "\n"
        with suppress(OSError), self.path.open("ab", buffering=0) as file:
            file.write(line.encode())
