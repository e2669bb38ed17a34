"""Files that another process has open on Windows, and text that is the same bytes on every system."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gsbake.atomic import write_atomic
from gsbake.pipeline.events import EventLog
from gsbake.system import disk

ROOT = Path(__file__).resolve().parents[2]


class InUse(PermissionError):
    """What Windows raises for a file that another process has open."""

    winerror = 32


def test_a_file_in_use_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace, tries = os.replace, []

    def busy(source: Path, target: Path) -> None:
        tries.append(target)
        if len(tries) < 4:
            raise InUse(13, "in use", str(target))
        replace(source, target)

    monkeypatch.setattr(os, "replace", busy)
    write_atomic(tmp_path / "a", "new")
    assert (tmp_path / "a").read_text() == "new" and len(tries) == 4
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_file_in_use_for_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "_PATIENCE", 0.05)

    def busy() -> None:
        raise InUse(13, "in use")

    with pytest.raises(InUse):
        disk.patiently(busy)


def test_other_errors_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk.time, "sleep", lambda seconds: pytest.fail("waited"))  # type: ignore[attr-defined]

    def refused() -> None:
        raise PermissionError(13, "Permission denied")

    with pytest.raises(PermissionError):
        disk.patiently(refused)


def test_folders_are_not_flushed_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[int] = []
    (tmp_path / "file").touch()
    monkeypatch.setattr(disk.os, "name", "nt")
    monkeypatch.setattr(disk.os, "open", lambda path, flags: opened.append(flags) or 7)  # type: ignore[func-returns-value]
    monkeypatch.setattr(disk.os, "fsync", lambda handle: None)
    monkeypatch.setattr(disk.os, "close", lambda handle: None)
    disk.sync(tmp_path)
    assert opened == []
    disk.sync(tmp_path / "file")
    assert opened == [os.O_RDWR]


def test_events_end_with_one_byte(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    log.write("é")
    log.write("second")
    content = (tmp_path / "events.jsonl").read_bytes()
    assert content.count(b"\n") == 2 and b"\r" not in content


def test_text_is_written_as_bytes() -> None:
    """`write_text` would end lines in another way on Windows, and an artifact's digest would be another there."""
    files = [path for folder in ("gsbake", "stages") for path in (ROOT / folder).rglob("*.py")]
    assert len(files) > 300
    assert [str(path) for path in files if ".write_text(" in path.read_text(encoding="utf-8")] == []
