"""Cameras at full size, the nearest photo, and what is read of the scorer's answer."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks import sharpness
from gsbake.capture.posed_photos import View
from tests.support.cameras import look_at

EYES = [(3 * np.cos(a), 3 * np.sin(a), 0.5) for a in np.linspace(0, 3, 8)]


class Photos:
    """Eight photos, whose working size is half of the full one."""

    posed: Any = SimpleNamespace(cameras=SimpleNamespace(cameras=[look_at(eye, size=40, name=f"p{k}") for k, eye in enumerate(EYES)]))

    def __len__(self) -> int:
        return len(EYES)

    def view(self, index: int) -> View:
        return View(self.posed.cameras.cameras[index].scaled(80, 80), np.zeros((80, 80, 3), np.uint8), np.zeros((80, 80), np.uint8))


def test_cameras_of_test_photos_are_those_of_the_full_photos(tmp_path: Path) -> None:
    frame = {"transform_matrix": np.eye(4).tolist(), "cx": 20.0, "cy": 19.0, "fl_x": 200.0, "fl_y": 210.0}
    (tmp_path / "small.json").write_text(json.dumps({"w": 40, "h": 40, "frames": [frame] * len(EYES)}), encoding="utf-8")
    photos: Any = Photos()
    written = json.loads(sharpness.full_cameras(tmp_path / "small.json", photos, tmp_path / "out").read_text(encoding="utf-8"))
    (one,) = written["frames"]
    assert (one["w"], one["h"], one["cx"], one["cy"], one["fl_x"], one["fl_y"]) == (80, 80, 40, 38, 400, 420)
    assert (tmp_path / "out" / "photos" / one["file_path"]).is_file() and (tmp_path / "out" / "masks" / one["file_path"]).is_file()


def test_the_nearest_photo_is_another_one() -> None:
    photos: Any = Photos()
    assert sharpness.nearest_photo(photos, 0) == 1 and sharpness.nearest_photo(photos, 7) == 6


def test_figures_are_read_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def answer(command: list[str], **_: Any) -> Any:
        asked.append(command)
        return SimpleNamespace(stdout=json.dumps({"rows": [["p1", 25.0, 0.8, 0.6, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.5]]}))

    monkeypatch.setattr(subprocess, "run", answer)
    (tmp_path / "masks").mkdir()
    found = sharpness.score(tmp_path / "a.glb", tmp_path / "cameras.json", 1200, tmp_path, ["p1"])
    assert found["p1"]["psnr"] == 25 and found["p1"]["detail"] == 0.6 and found["p1"]["aligned_2"] == 0.5 and found["p1"]["shift"] == 1.5
    assert asked[0][-2:] == ["--names", "p1"] and "--masks" in asked[0]


def test_true_colours_stand_in_place_of_the_test_photos(tmp_path: Path) -> None:
    """By name, in another order than the capture has them; alpha becomes the masks."""
    (tmp_path / "gt" / "base_color").mkdir(parents=True)
    for grey, name in enumerate(("a.png", "b.png", "c.png")):
        image = np.full((3, 4, 4), 100 + grey, np.uint8)
        image[..., 3] = [0, 255, 255, 255]
        Image.fromarray(image).save(tmp_path / "gt" / "base_color" / name)
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": [{"file_path": "c.png"}, {"file_path": "a.png"}]}), encoding="utf-8")
    cameras = sharpness.true_colours(tmp_path, tmp_path / "cameras.json")
    photo, mask = (np.asarray(Image.open(cameras.parent / kind)) for kind in ("photos/c.png", "masks/a.png"))
    assert np.unique(photo).tolist() == [102] and mask[0].tolist() == [0, 255, 255, 255]
    assert sorted(path.name for path in (cameras.parent / "photos").iterdir()) == ["a.png", "c.png"]
