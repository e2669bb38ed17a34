"""Tables of what was tried against gsbake: known holes, parsers, commands in a home of look-alikes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.lab.tables import Line, Maker, Table, read

COMMAND = "python -m benchmarks.safety"
#: Groups of commands; the others only read.
_GROUPS = ("run, mesh", "batch, plan", "replace, masks", "synth", "cache", "compare, render")
_OTHERS = "others"


def _lines(results: Path, kind: str) -> list[Line]:
    return [line for line in read(results, "safety") if line["kind"] == kind]


def _total(lines: list[Line], column: str) -> str:
    return str(sum(int(line[column]) for line in lines))


def holes(results: Path) -> Table:
    """Each hole, how it ended before, and its tests now."""
    lines = _lines(results, "hole")
    rows = [[line["name"], line["before"], line["cases"], line["failed"]] for line in lines]
    return Table(COMMAND, ("tried", "in 0.1.0", "tests", "failed"), rows, lines)


def parsers(results: Path) -> Table:
    """Parsers by the number of inputs that each got."""
    lines = _lines(results, "fuzz")
    rows = []
    for count in dict.fromkeys(line["cases"] for line in lines):
        found = [line for line in lines if line["cases"] == count]
        names = ", ".join(line["name"] for line in found)
        rows.append([names, count, _total(found, "failed")])
    return Table(COMMAND, ("parsers", "inputs each", "undocumented outcomes"), rows, lines)


def commands(results: Path) -> Table:
    """Commands in groups: runs, the user's files before each, and what was wrong after all of them."""
    lines = _lines(results, "home")
    grouped: dict[str, list[Line]] = {}
    for line in lines:
        command = line["name"].split()[1]
        grouped.setdefault(next((group for group in _GROUPS if command in group.split(", ")), _OTHERS), []).append(line)
    rows = [
        [name, _total(found, "cases"), *(_total(found, column) for column in ("missing", "changed", "new"))]
        for name, found in grouped.items()
    ]
    return Table(COMMAND, ("command", "runs", f"of {lines[0]['files']} files missing", "changed", "new among them"), rows, lines)


TABLES: Mapping[str, Maker] = {"holes": holes, "parsers": parsers, "commands": commands}
