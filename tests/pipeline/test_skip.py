"""Decisions on skipped work: setting and evidence, report, and saved time in manifest and event log; parts that follow each other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsbake.monitor import PartSequence, Rule, decide_skip, skips
from tests.pipeline.toy import engine
from tests.support.recorder import Recorder


@pytest.mark.parametrize(
    ("rule", "holds", "skip"),
    [("auto", True, True), ("auto", False, False), ("skip", False, True), ("keep", True, False)],
)
def test_setting_overrides_evidence(rule: Rule, holds: bool, skip: bool) -> None:
    monitor = Recorder()
    assert skips(rule, holds) is skip
    assert decide_skip(monitor, "redundant_photos", rule, holds, "3 of 9", "dropped", "kept", 4.0) is skip
    choice, evidence = monitor.decisions["skip.redundant_photos"]
    assert choice == ("dropped" if skip else "kept") and evidence.startswith("3 of 9")
    assert ("set by the profile" in evidence) == (rule != "auto")
    assert monitor.saved["skip.redundant_photos"] == (4.0 if skip else None)


def test_saved_time_is_in_manifest_and_event_log(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.txt").write_text("one two")
    states = engine(tmp_path / "out", photos)[0].run()
    assert states[1].artifact is not None
    done = {"what": "rest", "choice": "skipped", "evidence": "not needed", "saved_s": 12.3}
    assert states[1].artifact.manifest["decisions"] == [done]
    lines = [json.loads(line) for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines()]
    assert [e.get("saved_s") for e in lines if e["event"] == "decision"] == [None, 12.3]


def test_parts_that_follow_each_other() -> None:
    monitor = Recorder()
    with PartSequence(monitor) as parts:
        for name in ("matching", "matching", "mapping"):
            parts.start(name)
        assert list(monitor.parts) == ["matching"]  # the present one is not over
    assert list(monitor.parts) == ["matching", "mapping"]
