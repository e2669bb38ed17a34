"""CSV files of benchmark rows: dataclasses of texts, whole numbers and floats (or None). Rows of one `key` replace each other."""

from __future__ import annotations

import csv
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar


def today() -> str:
    """Today's date (UTC), year first."""
    return datetime.now(UTC).date().isoformat()


def current_commit() -> str:
    """The short hash of the checkout, with a plus where it has changes."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=Path(__file__).parent, capture_output=True, text=True, check=False).stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


class KeyedRow(Protocol):
    """A dataclass with a key."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one key replace each other."""


AnyRow = TypeVar("AnyRow", bound=KeyedRow)


def read_rows(path: Path, kind: type[AnyRow]) -> list[AnyRow]:
    """The rows of a CSV file written by `write_rows`; none when it does not exist."""
    if not path.is_file():
        return []
    kinds: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "float | None": _optional}
    parsers = {f.name: kinds.get(str(f.type), str) for f in fields(kind)}
    with path.open(newline="") as file:
        return [kind(**{name: parsers[name](value) for name, value in line.items()}) for line in csv.DictReader(file)]


def _optional(text: str) -> float | None:
    return float(text) if text else None


def write_rows(path: Path, rows: Sequence[KeyedRow]) -> None:
    """Write one or more rows of one kind; of several with one key, the last."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(rows[0])], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in {row.key: row for row in rows}.values())
