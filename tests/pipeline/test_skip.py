"""Decisions on work left out: evidence against profile, what is logged, and that seconds saved reach the manifest."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsbake.pipeline.skip import leave_out, wanted
from tests.pipeline.toy import engine


class Log:
    """As much of a context as a decision needs."""

    def __init__(self, mode: str) -> None:
        self.settings = SimpleNamespace(skip=SimpleNamespace(photos=mode))
        self.said: list[tuple[Any, ...]] = []

    def decide(self, *said: Any) -> None:
        self.said.append(said)


@pytest.mark.parametrize(
    ("mode", "holds", "out"),
    [("auto", True, True), ("auto", False, False), ("always", False, True), ("never", True, False)],
)
def test_the_profile_overrules_the_evidence(mode: str, holds: bool, out: bool) -> None:
    log: Any = Log(mode)
    assert wanted(log, "photos", holds) is out and leave_out(log, "photos", holds, "3 of 9", "dropped", "kept", 4.0) is out
    ((what, choice, evidence, saved),) = log.said
    assert what == "skip.photos" and choice == ("dropped" if out else "kept") and evidence.startswith("3 of 9")
    assert ("the profile asks for it" in evidence) == (mode != "auto") and saved == (4.0 if out else None)


def test_seconds_saved_reach_manifest_and_log(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.txt").write_text("one two")
    states = engine(tmp_path / "out", photos)[0].run()
    assert states[1].artifact is not None
    done = {"what": "rest", "choice": "left out", "evidence": "a sum needs none", "saved_s": 12.3}
    assert states[1].artifact.manifest["decisions"] == [done]
    lines = [json.loads(line) for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines()]
    assert [e.get("saved_s") for e in lines if e["event"] == "decision"] == [None, 12.3]
