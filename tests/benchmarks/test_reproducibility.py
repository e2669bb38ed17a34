"""The table of differences between runs."""

from __future__ import annotations

from benchmarks.reproducibility import StageFiles, differing, table


def test_files_that_differ_or_are_missing_are_named() -> None:
    runs = [
        {"ingest": StageFiles({"a": "1"}, 1.0), "poses": StageFiles({"a": "1", "b": "2"}, 2.0)},
        {"ingest": StageFiles({"a": "1"}, 1.0), "poses": StageFiles({"a": "3", "c": "2"}, 3.0)},
    ]
    assert differing(runs) == {"ingest": [], "poses": ["a", "b", "c"]}
    assert differing(runs[:1]) == {"ingest": [], "poses": []}
    rows = table(runs, [2, 1]).splitlines()
    assert rows[2] == "| ingest | 1.0 s | 1.0 s | none |" and rows[3] == "| poses | 2.0 s | 3.0 s | 3 of 2: a, b, c |"
