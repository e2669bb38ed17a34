"""Photos and masks that were replaced by hand by those of another size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsbake.capture.estimate_poses import estimate_poses
from gsbake.capture.photos.replaced import require_sizes
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet
from gsbake.imaging.png import write_png
from tests.support.cameras import look_at


def photo(folder: Path, name: str, width: int, height: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_png(folder / name, np.zeros((height, width), np.uint8))


def test_all_are_named_with_what_to_do(tmp_path: Path) -> None:
    photo(tmp_path / "photos", "a.png", 40, 30)
    photo(tmp_path / "photos", "b.png", 30, 40)
    photo(tmp_path / "masks", "a.png", 80, 60)
    (tmp_path / "photos/c.png").write_bytes(b"no picture")
    photo(tmp_path / "photos", "d.png", 40, 30)
    (tmp_path / "photos/d.png").write_bytes((tmp_path / "photos/d.png").read_bytes()[:-20])
    sizes = dict.fromkeys("abcde", (40, 30))
    with pytest.raises(BadInputError) as found:
        require_sizes(tmp_path, sizes, "ingest")
    wrong = "masks/a.png is 80 × 60, not 40 × 30", "photos/b.png is 30 × 40, not 40 × 30"
    listed = ", ".join((*wrong, "photos/c.png cannot be read", "photos/d.png cannot be read")) + "; give"
    assert listed in str(found.value)
    assert "`gsbake replace ingest --undo`" in str(found.value)
    require_sizes(tmp_path, {"b": (30, 40)}, "ingest")


def test_every_stage_refuses_them(tmp_path: Path) -> None:
    """Those of the poses stage where they are opened, those of ingest where poses begin."""
    CameraSet((look_at((0, -3, 0), size=40, focal=50, name="a"),)).save(tmp_path / "cameras.json")
    photo(tmp_path / "photos", "a.png", 40, 40)
    assert len(PosedPhotos.open(tmp_path)) == 1
    photo(tmp_path / "photos", "a.png", 20, 20)
    with pytest.raises(BadInputError, match="of the stage poses .*photos/a.png is 20 × 20, not 40 × 40"):
        PosedPhotos.open(tmp_path)
    (tmp_path / "photos.json").write_text(json.dumps({"photos": [{"name": "a", "width": 40, "height": 40}]}))
    with pytest.raises(BadInputError, match="of the stage ingest .*photos/a.png is 20 × 20, not 40 × 40"):
        estimate_poses(tmp_path, tmp_path / "out")
