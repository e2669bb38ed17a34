"""The table of differences between runs."""

from __future__ import annotations

from benchmarks.reproducibility import Row, StageFiles, differing, rows, table


def test_files_that_differ_or_are_missing_are_named() -> None:
    runs = [
        {"ingest": StageFiles({"a": "1"}, 1.0), "poses": StageFiles({"a": "1", "b": "2"}, 2.0)},
        {"ingest": StageFiles({"a": "1"}, 1.0), "poses": StageFiles({"a": "3", "c": "2"}, 3.0)},
    ]
    assert differing(runs) == {"ingest": [], "poses": ["a", "b", "c"]}
    assert differing(runs[:1]) == {"ingest": [], "poses": []}
    lines = table(runs, [2, 1]).splitlines()
    assert lines[2] == "| ingest | 1.0 s | 1.0 s | none |" and lines[3] == "| poses | 2.0 s | 3.0 s | 3 of 2: a, b, c |"
    assert rows("cup", "smoke", runs, [2, 1])[1] == Row("cup", "smoke", "poses", "2 1", 2, 3)
