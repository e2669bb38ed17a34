"""Output of the commands: all that they print passes here, so that no name from an untrusted file reaches the terminal as it is.

Text is made printable and never read as console markup (a photo may be called `[bold]`). JSON is ASCII: its escapes cover the same
characters, and whoever parses it gets the exact names.
"""

from __future__ import annotations

import json
from typing import Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gsbake.text import printable


def cell(text: object, style: str = "") -> Text:
    """Text for the console: printable, without markup."""
    return Text(printable(str(text)), style=style)


def print_text(text: str, *, error: bool = False) -> None:
    """Print one line to stdout, or with `error` to stderr."""
    typer.echo(printable(text), err=error)


def print_json(document: object, indent: int | None = 1) -> None:
    """Print a JSON document to stdout."""
    typer.echo(json.dumps(document, indent=indent, ensure_ascii=True))


def print_table(columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Print a table; cells are texts, or already `cell`s."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows:
        table.add_row(*(value if isinstance(value, Text) else cell(value) for value in row))
    Console(highlight=False).print(table)
