"""Whether runs of one capture with one seed write the same bytes: digests of every stage's files, and its seconds.

python -m benchmarks.reproducibility CAPTURE [--runs 3] [--threads 2 --threads 1] [--until poses] [--profile preview] [--set KEY=VALUE …]
    [--csv FILE]

Writes a row per stage to the CSV file, where rows of other captures and stages stay. The report is left out: it shows run times.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import gsbake
from benchmarks.csv_rows import read_rows, today, write_rows


@dataclass(frozen=True)
class StageFiles:
    """Files of a stage with their digests, and the seconds it took."""

    files: Mapping[str, str]
    seconds: float


Run = Mapping[str, StageFiles]
RESULTS = Path(__file__).parent / "results" / "reproducibility.csv"


@dataclass(frozen=True)
class Row:
    """One stage of one capture: threads of the runs, number of files, and how many of them are not the same in all runs."""

    capture: str
    profile: str
    stage: str
    threads: str
    files: int
    different: int
    date: str = field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one stage of one capture replace each other."""
        return self.capture, self.profile, self.stage


def measure(capture: Path, out: Path, threads: int, until: str, profile: str, settings: Mapping[str, str]) -> Run:
    """Run the stages up to `until` in the empty folder `out`."""
    result = gsbake.run(capture, out=out, profile=profile, settings=settings, until=until, threads=threads)
    found = {}
    for state in result.stages:
        assert state.artifact is not None
        found[state.name] = StageFiles(dict(state.artifact.files), float(state.artifact.manifest["seconds"]))
    return found


def differing(runs: Sequence[Run]) -> dict[str, list[str]]:
    """{stage: files that are not the same in all runs}, for every stage."""
    return {
        stage: sorted(
            name for name in set().union(*(run[stage].files for run in runs)) if len({run[stage].files.get(name) for run in runs}) > 1
        )
        for stage in runs[0]
    }


def table(runs: Sequence[Run], threads: Sequence[int]) -> str:
    """Markdown table: a stage a row, seconds of every run, and the files that differ."""
    lines = ["| stage | " + " | ".join(f"run {k + 1}, {count} threads" for k, count in enumerate(threads)) + " | files that differ |"]
    lines.append("|---" * (len(runs) + 2) + "|")
    for stage, names in differing(runs).items():
        seconds = " | ".join(f"{run[stage].seconds:.1f} s" for run in runs)
        shown = ", ".join(names[:6]) + (" …" if len(names) > 6 else "")
        lines.append(f"| {stage} | {seconds} | {f'{len(names)} of {len(runs[0][stage].files)}: {shown}' if names else 'none'} |")
    return "\n".join(lines)


def rows(capture: str, profile: str, runs: Sequence[Run], threads: Sequence[int]) -> list[Row]:
    """A row per stage."""
    counts = " ".join(str(count) for count in threads)
    return [Row(capture, profile, stage, counts, len(runs[0][stage].files), len(names)) for stage, names in differing(runs).items()]


def main() -> None:
    """Run the capture several times and print the table; exit code 1 when anything differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--threads", type=int, action="append", help="numbers of threads, taken in turn; default 2")
    parser.add_argument("--until", default="poses")
    parser.add_argument("--profile", default="preview")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--csv", type=Path, default=RESULTS)
    args = parser.parse_args()
    counts = [(args.threads or [2])[k % len(args.threads or [2])] for k in range(args.runs)]
    settings = dict(text.split("=", 1) for text in args.settings)
    with tempfile.TemporaryDirectory(prefix="gsbake-runs-") as folder:
        runs = [
            measure(args.capture, Path(folder) / str(k), count, args.until, args.profile, settings) for k, count in enumerate(counts)
        ]  # fmt: skip
    sys.stdout.write(table(runs, counts) + "\n")
    write_rows(args.csv, [*read_rows(args.csv, Row), *rows(args.capture.name, args.profile, runs, counts)])
    sys.exit(1 if any(differing(runs).values()) else 0)


if __name__ == "__main__":
    main()
