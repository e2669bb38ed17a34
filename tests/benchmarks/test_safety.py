"""The table of what was tried: outcomes of tests by hole, and the lines that fuzz tests and tests/safety print."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import safety
from benchmarks.holes import HOLES, Hole
from benchmarks.lab.safety import TABLES

REPORT = """<testsuites><testsuite>
<testcase classname="tests.a.test_b" name="test_c[1]"/><testcase classname="tests.a.test_b" name="test_c[2]"><failure/></testcase>
<testcase classname="tests.a.test_b" name="test_d"><skipped/></testcase><testcase classname="tests.a.test_b" name="test_e"/>
</testsuite></testsuites>"""
FUZZ = "fuzz: GLB: 100 inputs, 0 undocumented outcomes (3 read, the others refused)\n.\nFAILED tests/fuzz/test_x.py::test_y - boom\n"
HOME = "home: gsbake cache gc --out TARGET: 24 targets, 95 files, 8 missing, 1 changed, 3 new ones among them\n"


def test_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[str, ...]] = []

    def answer(*words: str, **variables: str) -> str:
        calls.append(words)
        for word in words:
            if word.startswith("--junitxml="):
                Path(word.removeprefix("--junitxml=")).write_text(REPORT)
        return FUZZ if words[0] == "tests/fuzz" else HOME

    monkeypatch.setattr(safety, "_pytest", answer)
    holes = (
        Hole("c", "lost", ("tests/a/test_b.py::test_c",)), Hole("file", "lost", ("tests/a/test_b.py",)),
        Hole("skipped", "lost", ("tests/a/test_b.py::test_d",)),
    )  # fmt: skip
    rows = safety.hole_rows(holes)
    assert [(row.cases, row.failed, row.open) for row in rows] == [(2, 1, True), (3, 1, True), (1, 1, True)]
    assert calls[0][:2] == ("-k", "test_b or test_c or test_d")  # there is no such file
    assert [(row.name, row.cases, row.failed) for row in safety.fuzz_rows("glb", 200)] == [("GLB", 100, 0), ("test_x.py::test_y", 200, 1)]
    (row,) = safety.home_rows()
    assert (row.cases, row.files, row.missing, row.changed, row.new, row.open) == (24, 95, 8, 1, 3, True)
    path = tmp_path / "safety.csv"
    assert safety.main(["--csv", str(path)]) == 1
    assert {name: len(maker(tmp_path).rows) for name, maker in TABLES.items()} == {"holes": len(HOLES), "parsers": 2, "commands": 1}
