"""Photos alone: masks and poses of a capture are not copied; what the hull of all photos leaves out is found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.csv_rows import read_rows, write_rows
from benchmarks.photos import RESULTS, Row, left_out_pct, photos_alone
from gsbake.errors import UsageError
from gsbake.geometry.cameras import CameraSet
from tests.support.cameras import look_at


def test_only_photos_are_copied(tmp_path: Path) -> None:
    capture = tmp_path / "cup"
    for name in ("photos/a.png", "photos/b.png", "masks/a.png"):
        (capture / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(capture / name), np.zeros((8, 8, 3), np.uint8))
    (capture / "transforms.json").write_text("{}")
    copied = photos_alone(capture, tmp_path / "alone")
    assert sorted(path.name for path in copied.iterdir()) == ["a.png", "b.png"]
    with pytest.raises(UsageError, match="no folder of photos"):
        photos_alone(capture / "masks", tmp_path / "none")


def test_a_part_that_one_group_shows_is_left_out(tmp_path: Path) -> None:
    """Discs from eight sides; in the two photos of the last group the disc is twice as wide, which no hull of all photos covers."""
    for folder in ("photos", "masks"):
        (tmp_path / folder).mkdir()
    cameras = []
    for i, turn in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        camera = look_at((3 * np.cos(turn), 3 * np.sin(turn), 0.5), size=64, focal=90.0, name=f"{i}")
        mask = cv2.circle(np.zeros((64, 64), np.uint8), (32, 32), 20 if i > 5 else 10, 255, -1)
        cv2.imwrite(str(tmp_path / "masks" / f"{i}.png"), mask)
        cv2.imwrite(str(tmp_path / "photos" / f"{i}.png"), mask)
        cameras.append(camera)
    CameraSet(tuple(cameras)).save(tmp_path / "cameras.json")
    assert left_out_pct(tmp_path, groups=1) < left_out_pct(tmp_path, groups=4)
    assert 50 < left_out_pct(tmp_path, groups=4) < 100


def test_rows_round_trip(tmp_path: Path) -> None:
    row = Row("fox", "preview", 50, 50, 0.84, 0.85, 0, None, None, None, 60.0, "abc", "cpu", "2026-11-28")
    write_rows(tmp_path / "photos.csv", [row])
    assert read_rows(tmp_path / "photos.csv", Row) == [row] and RESULTS.name == "photos.csv"
