"""Photos that share intrinsics: by model and serial number, or by sub-folder where EXIF has no number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from gsbake.capture.sfm.lenses import MIN_FOLDER_PHOTOS, solved_lenses
from tests.capture.conftest import Runner, picture

#: Numbers of EXIF tags.
MAKE, MODEL, EXIF, FOCAL_35, WIDTH, HEIGHT, SERIAL = 0x010F, 0x0110, 0x8769, 0xA405, 0xA002, 0xA003, 0xA431


def photo(path: Path, seed: int, size: tuple[int, int] = (64, 48), **tags: Any) -> None:
    """A photo whose camera wrote 4000 x 3000 pixels with a focal length of 50 mm."""
    exif = Image.Exif()
    exif[MAKE], exif[MODEL] = "Maker", "One"
    exif.get_ifd(EXIF).update({FOCAL_35: 50, WIDTH: 4000, HEIGHT: 3000} | ({SERIAL: tags["serial"]} if "serial" in tags else {}))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(seed, size[1], size[0])).save(path, exif=exif)


def entries(runner: Runner) -> list[dict[str, Any]]:
    return list(json.loads((runner.root / "ingest" / "photos.json").read_text(encoding="utf-8"))["photos"])


def test_two_bodies_of_one_model(tmp_path: Path, runner: Runner) -> None:
    """The number itself is not written: outputs are passed on."""
    for k in range(4):
        photo(tmp_path / "images" / f"p{k}.jpg", k, serial="SN-0042" if k % 2 else "SN-0043")
    _, done = runner.ingest(tmp_path)
    lenses, folders = solved_lenses(entries(runner))
    assert [lens["names"] for lens in lenses] == [["p0", "p2"], ["p1", "p3"]] and folders == ""
    assert "SN-004" not in (done.out / "photos.json").read_text(encoding="utf-8") and not done.warnings


def listing(counts: dict[str, int], **more: Any) -> list[dict[str, Any]]:
    shared = {"width": 64, "height": 48, "camera_model": "Maker One", "focal_px": 60.0, "camera_body": None, **more}
    return [{"name": f"{sub}{k}", "source": f"{sub}/{k}.jpg", **shared} for sub, count in counts.items() for k in range(count)]


@pytest.mark.parametrize(
    ("counts", "more", "cameras"),
    [
        ({"left": MIN_FOLDER_PHOTOS, "right": MIN_FOLDER_PHOTOS + 1}, {}, 2),
        ({"left": MIN_FOLDER_PHOTOS, "right": MIN_FOLDER_PHOTOS - 1}, {}, 1),
        ({"left": MIN_FOLDER_PHOTOS, "right": MIN_FOLDER_PHOTOS}, {"camera_body": "ab"}, 1),
        ({"left": MIN_FOLDER_PHOTOS, "right": MIN_FOLDER_PHOTOS}, {"camera_model": ""}, 1),
        ({"left": 2 * MIN_FOLDER_PHOTOS}, {}, 1),
    ],
)
def test_sub_folders_without_serial_numbers(counts: dict[str, int], more: dict[str, Any], cameras: int) -> None:
    lenses, evidence = solved_lenses(listing(counts, **more))
    assert len(lenses) == cameras and bool(evidence) == (cameras == 2)
    assert sum(len(lens["names"]) for lens in lenses) == sum(counts.values())


def test_crops_that_kept_their_exif_are_named(tmp_path: Path, runner: Runner) -> None:
    """One of the same aspect ratio as the others but smaller, and one of another standard ratio; a small one of another camera is none."""
    for k in range(3):
        photo(tmp_path / "images" / f"p{k}.jpg", k)
    photo(tmp_path / "images" / "same.jpg", 3, (48, 36))
    photo(tmp_path / "images" / "wide.jpg", 4, (64, 36))
    photo(tmp_path / "images" / "other.jpg", 5, (48, 36), serial="7")
    _, done = runner.ingest(tmp_path)
    assert [w for w in done.warnings if "cropped" in w] == [
        "2 photos seem cropped, for EXIF tells of more of the picture (same, wide); poses are better from whole photos."
    ]
    focal = {entry["name"]: entry["focal_px"] for entry in entries(runner)}
    assert focal["same"] is None and focal["wide"] is None and focal["p0"] == pytest.approx(focal["other"] * 64 / 48)


def test_reduced_photos_are_no_crops(tmp_path: Path, runner: Runner) -> None:
    for k in range(3):
        photo(tmp_path / "images" / f"p{k}.jpg", k, (32, 24) if k else (24, 32))
    _, done = runner.ingest(tmp_path)
    assert not any("cropped" in w for w in done.warnings) and all(entry["focal_px"] for entry in entries(runner))
