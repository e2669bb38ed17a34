"""Figures as people read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Figures shown on a stage's line; the manifest holds all of them.
SHOWN = 4


def duration(seconds: float) -> str:
    """0.3 s, 42 s, 3 min 05 s, 2 h 07 min."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 60:
        return f"{seconds:.0f} s"
    whole = round(seconds)
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


def figure(value: float) -> str:
    """A number with the digits that matter."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    return f"{value:.4g}"


def figures(results: Mapping[str, Any], limit: int = SHOWN) -> str:
    """The first few plain numbers and words among a stage's results."""
    shown = []
    for name, value in results.items():
        if isinstance(value, bool | int | float):
            shown.append(f"{name.replace('_', ' ')} {figure(value)}")
        elif isinstance(value, str) and len(value) <= 24:
            shown.append(f"{name.replace('_', ' ')} {value}")
        if len(shown) == limit:
            break
    return ", ".join(shown)
