from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from benchmarks.masks import compare, line, silhouettes
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.ply import write_mesh
from gsbake.synth.capture import look_at


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


def test_silhouettes_of_the_mesh_are_compared_with_undistorted_masks(tmp_path: Path) -> None:
    """A square of half the photo's width before a camera that looks at it, and masks of it and of its left half."""
    poses, mesh, truth = (tmp_path / name for name in ("poses", "mesh", "truth"))
    for folder in (poses, mesh, truth):
        folder.mkdir()
    camera = look_at("a", np.array([0.0, -4.0, 0.0]), np.zeros(3), 0.0, 160.0, (40.0, 40.0), 80)
    for name in ("cameras.json", "photo_cameras.json"):
        CameraSet((camera,), poses="given").save(poses / name)
    write_mesh(mesh / "mesh.ply", [[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]], [[0, 1, 2], [0, 2, 3]])
    entry = {"name": "a", "source": "a.jpg", "file": "photos/a.png", "width": 80, "height": 80}
    (tmp_path / "photos.json").write_text(json.dumps({"photos": [entry]}))
    for columns, overlap in ((slice(20, 60), 1.0), (slice(20, 40), 0.5)):
        mask = np.zeros((80, 80), np.uint8)
        mask[20:60, columns] = 255
        cv2.imwrite(str(truth / "a.jpg.png"), mask)
        assert abs(silhouettes(poses, mesh, tmp_path, truth)["a"] - overlap) < 0.06
