"""Command lines of benchmarks: `python -m benchmarks.NAME [CAPTURE …] [--profile] [--out] [--csv]` of those that measure captures one by
one, and `python -m benchmarks.NAME RUN CAPTURE …` of those that print what they find in finished runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.csv_rows import AnyRow, read_rows, write_rows
from benchmarks.timeline import ROOT
from gsbake.errors import GsbakeError, UsageError


def measure_captures(
    description: str | None, names: Sequence[str], results: Path, kind: type[AnyRow], measure: Callable[[str, str, Path], AnyRow],
    arguments: Sequence[str] | None = None,
) -> None:  # fmt: skip
    """Write `measure(capture, profile, out)` of each capture, by default of `names`, into the file `results` at once.

    Ends with exit code 2 and one sentence where a capture cannot be measured.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", default=list(names))
    parser.add_argument("--profile", default="preview")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / results.stem)
    parser.add_argument("--csv", type=Path, default=results)
    options = parser.parse_args(arguments)
    for name in options.captures:
        try:
            row = measure(name, options.profile, options.out)
        except GsbakeError as error:
            parser.error(f"{name}: {error}")
        write_rows(options.csv, [*read_rows(options.csv, kind), row])
        sys.stdout.write(f"{row}\n")


def report_runs(
    name: str, description: str | None, report: Callable[[Sequence[tuple[Path, Path]]], str], arguments: Sequence[str] | None = None
) -> int:
    """Print the report on pairs of a finished run and its capture; the exit status."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", type=Path, nargs="+", metavar="RUN CAPTURE")
    pairs = parser.parse_args(arguments).pairs
    try:
        if len(pairs) % 2:
            raise UsageError("Give a run and its capture each.")
        print(report(list(zip(pairs[::2], pairs[1::2], strict=True))))
    except GsbakeError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
    return 0
