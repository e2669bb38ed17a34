"""What was tried against gsbake: known holes, damaged files for every parser, and every command that writes in a home of look-alikes.

python -m benchmarks.safety [--inputs 1000] [--gltf-inputs 10000] [--csv FILE]

Runs the regression tests of the holes (`benchmarks.holes`), the fuzz tests with that many inputs per parser, and tests/safety, and writes
one row for each hole, parser and command. Exit code 1 where something is open; the rows are written all the same.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from benchmarks.csv_rows import today, write_rows
from benchmarks.holes import HOLES, Hole

ROOT = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).parent / "results" / "safety.csv"
#: The lines that the fuzz tests and tests/safety print.
_FUZZ = re.compile(r"^fuzz: (.+): (\d+) inputs, (\d+) undocumented outcomes", re.M)
_HOME = re.compile(r"^home: (.+): (\d+) targets, (\d+) files, (\d+) missing, (\d+) changed, (\d+) new ones among them", re.M)
#: Words in the names of the fuzz tests of the glTF reader.
_GLTF = "gltf or glb"


@dataclass(frozen=True)
class Row:
    """A hole (`cases`: tests, `failed` of them), a parser (inputs, undocumented outcomes) or a command (targets).

    `files` of the user's were there before a command; afterwards some were `missing` or `changed`, or there were `new` ones in folders that
    were not gsbake's.
    """

    kind: str
    name: str
    before: str = ""
    cases: int = 0
    failed: int = 0
    files: int = 0
    missing: int = 0
    changed: int = 0
    new: int = 0
    date: str = dataclasses.field(default_factory=today)

    @property
    def key(self) -> tuple[str, ...]:
        """Rows of one kind and name replace each other."""
        return self.kind, self.name

    @property
    def open(self) -> bool:
        """Whether something was found."""
        return bool(self.failed or self.missing or self.changed or self.new)


def hole_rows(holes: Sequence[Hole] = HOLES) -> list[Row]:
    """How the regression tests of each hole end now; one that is missing or skipped counts as failed."""
    nodes = [test.partition("::") for hole in holes for test in hole.tests]
    files = sorted({file for file, _, _ in nodes if (ROOT / file).is_file()})
    names = " or ".join(sorted({test or Path(file).stem for file, _, test in nodes}))  # pytest takes the name of a file too
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        _pytest(*files, "-k", names, f"--junitxml={report}")
        ended = _read_report(report)
    rows = []
    for hole in holes:
        cases = [passed for test in hole.tests for passed in ended.get(test, [])]
        missing = [test for test in hole.tests if test not in ended]
        rows.append(Row("hole", hole.tried, hole.before, len(cases) + len(missing), cases.count(False) + len(missing)))
    return rows


def fuzz_rows(chosen: str, inputs: int) -> list[Row]:
    """Outcomes of the parsers whose tests are `chosen`; where one fails, its test prints no line and the row says one."""
    text = _pytest("tests/fuzz", "-k", chosen, GSBAKE_FUZZ_INPUTS=str(inputs))
    rows = [Row("fuzz", title, cases=int(tried), failed=int(bad)) for title, tried, bad in _FUZZ.findall(text)]
    return rows + [Row("fuzz", test, cases=inputs, failed=1) for test in re.findall(r"^FAILED tests/fuzz/(\S+)", text, re.M)]


def home_rows() -> list[Row]:
    """What each command did to the home."""
    found = _HOME.findall(_pytest("tests/safety", "-k", "everywhere"))
    return [Row("home", name, cases=int(n), files=int(f), missing=int(m), changed=int(c), new=int(x)) for name, n, f, m, c, x in found]


def _pytest(*words: str, **variables: str) -> str:
    """Standard output of pytest."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    return subprocess.run(command, cwd=ROOT, env={**os.environ, **variables}, stdout=subprocess.PIPE, text=True, check=False).stdout


def _read_report(path: Path) -> dict[str, list[bool]]:
    """{file, and file::test: whether each of its cases passed}; cases that were skipped are left out."""
    found: dict[str, list[bool]] = {}
    for case in ElementTree.parse(path).iter("testcase"):
        file = f"{case.get('classname', '').replace('.', '/')}.py"
        outcomes = {child.tag for child in case}
        for name in (file, f"{file}::{case.get('name', '').partition('[')[0]}") if "skipped" not in outcomes else ():
            found.setdefault(name, []).append(not outcomes & {"failure", "error"})
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Try everything, write the rows and print what is open."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1000)
    parser.add_argument("--gltf-inputs", type=int, default=10_000)
    parser.add_argument("--csv", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    with ThreadPoolExecutor(1) as beside:  # all of it takes as long as the rest
        parts = ((_GLTF, options.gltf_inputs), (f"not ({_GLTF})", options.inputs))
        fuzzed = [beside.submit(fuzz_rows, *part) for part in parts]
        rows = [*hole_rows(), *home_rows(), *(row for part in fuzzed for row in part.result())]
    write_rows(options.csv, rows)
    for row in rows:
        if row.open:
            sys.stdout.write(
                f"open: {row.kind}: {row.name}: {row.failed} failed, {row.missing} missing, {row.changed} changed, {row.new} new\n"
            )
    sys.stdout.write(f"{len(rows)} rows, {sum(row.open for row in rows)} open\n")
    return int(any(row.open for row in rows) or {row.kind for row in rows} != {"hole", "fuzz", "home"})


if __name__ == "__main__":
    sys.exit(main())
