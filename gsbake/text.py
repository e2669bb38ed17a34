"""Formatting of durations, file sizes, numbers, results and lists of names for messages; untrusted text made printable."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

#: Maximum number of results on a stage's line; the manifest has all.
MAX_FIGURES = 4
#: Maximum number of names in a message, and in one about what is missing from an input; the rest are counted.
MAX_NAMES, MAX_MISSING = 4, 10


def printable(text: str) -> str:
    """`text` on one line, with escapes (\\x1b, \\n, \\u202e, \\udcff) in place of characters that a terminal would not show as themselves.

    Names of files come from strangers: they may hold terminal control sequences, line breaks, marks that reverse the direction of writing,
    and bytes that are no text. Every message, event and cell of the report passes here; text that is printable is returned as it is.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode("ascii") for c in text)


def duration(seconds: float) -> str:
    """0.3 s, 42 s, 3 min 05 s, 2 h 07 min."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size(count: float) -> str:
    """480 kB, 3.2 MB, 1.25 GB."""
    if count < 1e6:
        return f"{count / 1e3:.0f} kB"
    if count < 1e9:
        return f"{count / 1e6:.1f} MB"
    return f"{count / 1e9:.2f} GB"


def number(value: float) -> str:
    """15 000, 0.0821, 24.6: integers in groups of three digits, other numbers with four significant digits; "yes" or "no" for bools."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or (abs(value) >= 1e4 and abs(value) < 1e15):
        return f"{round(value):,}".replace(",", " ")
    return f"{value:.4g}"


def figures(results: Mapping[str, Any], limit: int = MAX_FIGURES) -> str:
    """The first `limit` numbers and short texts among a stage's results."""
    shown = []
    for name, value in results.items():
        if isinstance(value, bool | int | float):
            shown.append(f"{name.replace('_', ' ')} {number(value)}")
        elif isinstance(value, str) and len(value) <= 24:
            shown.append(f"{name.replace('_', ' ')} {value}")
        if len(shown) == limit:
            break
    return ", ".join(shown)


def summarise(template: str, results: Mapping[str, Any]) -> str:
    """The template with results in its braces, as in "{photos} photos, {psnr:dB}"; comma-separated clauses without a result are dropped.

    The format after the colon is a unit: "dB" one decimal, "%" a share as a percentage, "MB" and "px" two decimals.
    """
    clauses = []
    for clause in filter(None, (part.strip() for part in template.split(","))):
        names = [name.partition(":") for name in re.findall(r"\{([^}]+)\}", clause)]
        if any(results.get(name) is None for name, _, _ in names):
            continue
        for name, colon, unit in names:
            clause = clause.replace("{" + name + colon + unit + "}", _with_unit(results[name], unit))
        clauses.append(clause)
    return ", ".join(clauses)


def _with_unit(value: Any, unit: str) -> str:
    match unit:
        case "%":
            return f"{100 * value:.0f} %"
        case "dB":
            return f"{value:.1f} dB"
        case "MB" | "px":
            return f"{value:.2f} {unit}"
        case _:
            return value if isinstance(value, str) else number(value)


def shortlist(names: Sequence[str], most: int = MAX_NAMES) -> str:
    """The first `most` names and the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def missing_list(names: Sequence[str]) -> str:
    """What an input lacks: the first MAX_MISSING names and the number of the others."""
    return shortlist(names, MAX_MISSING)
