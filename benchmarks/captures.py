"""Command line of a benchmark that measures captures one by one: `python -m benchmarks.NAME [CAPTURE …] [--profile] [--out] [--csv]`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.csv_rows import AnyRow, read_rows, write_rows
from benchmarks.timeline import ROOT
from gsbake.errors import GsbakeError


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
