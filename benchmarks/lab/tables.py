"""What a table of the lab is made of: rows of a CSV file, the newest of each kind, figures as text, and the Markdown they become."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

#: Columns that fit a page.
MAX_COLUMNS = 8
#: One row of a CSV file: texts by column. Every file has a column `date`.
Line = dict[str, str]


@dataclass(frozen=True)
class Table:
    """A table ready to be written: its headings, its rows of cells, the command that measures the figures, and the lines they are from."""

    command: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: Sequence[Line]

    def markdown(self) -> str:
        """The date of the measurements with their command, and the table. Raises ValueError for one that is too wide, ragged or empty."""
        if len(self.headings) > MAX_COLUMNS:
            raise ValueError(f"{len(self.headings)} columns; a page has room for {MAX_COLUMNS}")
        if not self.rows or any(len(row) != len(self.headings) for row in self.rows):
            raise ValueError("no rows, or rows of another length than the headings")
        dates = sorted({line["date"] for line in self.lines})
        span = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        head, *body = ("| " + " | ".join(cells) + " |" for cells in (self.headings, *self.rows))
        return "\n".join([f"Measured {span}: `{self.command}`", "", head, "|---" * len(self.headings) + "|", *body])


def read(folder: Path, name: str) -> list[Line]:
    """The lines of a file of results."""
    with (folder / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def newest(lines: Iterable[Line], *columns: str) -> list[Line]:
    """Of the lines with the same values in `columns` the one measured last, in the order in which each kind first occurs."""
    found: dict[tuple[str, ...], Line] = {}
    for line in lines:
        key = tuple(line[column] for column in columns)
        if key not in found or line["date"] >= found[key]["date"]:
            found[key] = line
    return list(found.values())


def number(text: str, digits: int, factor: float = 1) -> str:
    """A figure with so many digits after the point, or a dash where there is none."""
    return f"{factor * float(text):.{digits}f}" if text else "–"


def change(before: str, after: str, digits: int, factor: float = 1) -> str:
    """Two figures with an arrow between them; one where they are the same."""
    first, second = number(before, digits, factor), number(after, digits, factor)
    return first if first == second else f"{first} → {second}"


def signed(value: float, digits: int) -> str:
    """A difference with its sign; 0 where it rounds to that."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text if any(digit in "123456789" for digit in text) else "0"


def spaced(name: str) -> str:
    """The name of a capture or object in words."""
    return name.replace("_photos", "").replace("_", " ")


def mean(lines: Iterable[Line], column: str) -> float:
    """Mean of the figures that are there. Raises ZeroDivisionError without any."""
    values = [float(line[column]) for line in lines if line[column]]
    return sum(values) / len(values)


#: A function that makes a table from the folder of results.
Maker = Callable[[Path], Table]
