from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from benchmarks.masks import compare, line


def test_masks_are_compared_at_the_size_of_the_photo(tmp_path: Path) -> None:
    ingest, poses, truth = tmp_path / "ingest", tmp_path / "poses", tmp_path / "truth"
    for folder in (ingest / "guesses", poses / "photo_masks", truth):
        folder.mkdir(parents=True)
    half, all_ = np.zeros((40, 60), np.uint8), np.full((40, 60), 255, np.uint8)
    half[:, :30] = 255
    cv2.imwrite(str(truth / "a.jpg.png"), cv2.resize(all_, (120, 80)))
    cv2.imwrite(str(ingest / "guesses" / "a.png"), half)
    cv2.imwrite(str(poses / "photo_masks" / "a.png"), all_)
    entry = {"name": "a", "source": "a.jpg", "file": "photos/a.png", "guess": "guesses/a.png", "width": 60, "height": 40}
    (ingest / "photos.json").write_text(json.dumps({"photos": [entry]}))
    found = compare(ingest, poses, truth)
    assert found["in use"] == {"a": 1.0} and abs(found["guesses"]["a"] - 0.5) < 0.01
    assert "worst 0.500; below .9: a 0.500" in line("guesses", found["guesses"]) and line("x", {}) == "x: none"
