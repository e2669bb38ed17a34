"""Bounds on figures, for continuous integration: `gsbake compare --fail-under` and `gsbake run --require`.

A figure fails where it is worse than its bound: below it where more is better (decibels, similarity), above it where less is better
(distances, angles, errors, sizes, times). The command then does all that it does otherwise, and ends with an exit code of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import typer

from gsbake.cli.output import print_text

#: Exit code of a command whose figures are worse than a bound.
WORSE = 3

#: {figure of `compare --json`: whether more is better}; those with "truth." are the second file's against --truth.
COMPARED = {
    "chamfer": False, "max_distance": False, "normal_degrees": False,
    "render_psnr": True, "render_ssim": True, "base_color_psnr": True, "roughness_error": False, "metallic_error": False,
    "shading_normal_degrees": False, "silhouette_iou": True,
    "truth.chamfer": False, "truth.max_distance": False, "truth.normal_degrees": False,
}  # fmt: skip
#: {figure of `report.json`: whether more is better}.
REPORTED = {
    "psnr": True, "exposed_psnr": True, "ssim": True, "triangles": False, "bytes": False, "seconds": False, "peak_bytes": False,
}  # fmt: skip

Bounds = tuple[tuple[str, float], ...]


def bounds_parser(figures: Mapping[str, bool]) -> Callable[[str], Bounds]:
    """Parser of an option's KEY=VALUE,… with the keys of `figures`."""

    def parse(text: str) -> Bounds:
        found = []
        for part in text.split(","):
            key, equals, number = (piece.strip() for piece in part.partition("="))
            if not equals or not number:
                raise typer.BadParameter(f"'{part.strip()}' is not KEY=VALUE, as in {next(iter(figures))}=0.5")
            if key not in figures:
                raise typer.BadParameter(f"there is no figure '{key}'; choose from {', '.join(figures)}")
            try:
                bound = float(number)
            except ValueError:
                bound = math.nan
            if not math.isfinite(bound):
                raise typer.BadParameter(f"'{number}' is not a number, in '{part.strip()}'")
            found.append((key, bound))
        return tuple(found)

    return parse


def check_bounds(bounds: Iterable[tuple[str, float]], values: Mapping[str, Any], figures: Mapping[str, bool]) -> list[str]:
    """What is worse than its bound, one phrase each; a figure without a value is."""
    worse = []
    for key, bound in bounds:
        value = values.get(key)
        if value is None or not (value >= bound if figures[key] else value <= bound):
            shown = "none" if value is None else f"{value:.10g}"
            worse.append(f"{key} is {shown}, not {'at least' if figures[key] else 'at most'} {bound:.10g}")
    return worse


def gate_document(worse: list[str]) -> dict[str, Any]:
    """What the JSON document of the command says of its bounds: the exit code, and the sentence of a failure."""
    return {"exit_code": WORSE, "error": _sentence(worse)} if worse else {"exit_code": 0}


def end_at_gate(worse: list[str]) -> None:
    """Print what is worse to stderr and end the command; nothing where nothing is."""
    if worse:
        print_text(f"gsbake: {_sentence(worse)}", error=True)
        raise typer.Exit(WORSE)


def _sentence(worse: list[str]) -> str:
    return f"Worse than required: {'; '.join(worse)}."
