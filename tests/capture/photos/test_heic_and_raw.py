"""Photos of telephones (HEIC) and undeveloped photos of cameras (RAW, as DNG) become photos like others."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.photos.decode import UnreadablePhotoError, read_header, read_photo
from gsbake.capture.photos.exif import camera_key, focal_pixels
from gsbake.capture.sources import list_photos
from gsbake.errors import BadInputError
from tests.capture.conftest import Runner
from tests.support.dng import write_dng

#: 64 x 48 pixels of a pattern, turned by EXIF's orientation 6, with a camera's name and a focal length of 26 mm (35 mm equivalent).
TELEPHONE = Path(__file__).with_name("telephone.heic")


def pattern() -> NDArray[np.uint8]:
    y, x = np.mgrid[0:48, 0:64]
    return np.stack([x * 4 % 256, y * 5 % 256, (x + y) * 2 % 256], -1).astype(np.uint8)


def smooth(height: int = 96, width: int = 128) -> NDArray[np.float64]:
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([0.1 + 0.5 * x / width, 0.2 + 0.3 * y / height, 0.5 - 0.3 * x / width], -1)


def test_heic_is_upright_with_its_camera() -> None:
    photo = read_photo(TELEPHONE)
    upright = np.rot90(pattern(), -1)
    assert photo.pixels.dtype == np.uint8 and photo.pixels.shape == upright.shape and photo.alpha is None
    assert photo.orientation == 1
    inner = np.abs(photo.pixels.astype(int) - upright)[2:-2, 2:-2]
    assert np.median(inner) <= 3
    assert camera_key(photo.tags).startswith("Maker Phone 1")
    assert focal_pixels(photo.tags, photo.width, photo.height) == pytest.approx(26 / np.hypot(36, 24) * 80)
    header = read_header(TELEPHONE)
    assert (header.width, header.height, header.channels, header.sample_bytes) == (48, 64, 3, 1)


@pytest.mark.parametrize("orientation", [1, 6])
def test_raw_is_linear_and_not_brightened(tmp_path: Path, orientation: int) -> None:
    write_dng(tmp_path / "a.dng", smooth(), orientation)
    photo = read_photo(tmp_path / "a.dng")
    expected = smooth() if orientation == 1 else np.rot90(smooth(), -1)
    assert photo.pixels.dtype == np.float32 and photo.pixels.shape == expected.shape
    assert np.abs(photo.pixels / expected - 1)[8:-8, 8:-8].max() < 0.02
    assert camera_key(photo.tags).startswith("Maker Camera 1")
    header = read_header(tmp_path / "a.dng")
    assert (header.height, header.width) == expected.shape[:2]
    assert header.channels * header.sample_bytes == photo.pixels.nbytes / photo.pixels[..., 0].size


def test_damaged_files_are_unreadable(tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", smooth())
    for name, content in (("a.dng", (tmp_path / "a.dng").read_bytes()), ("b.heic", TELEPHONE.read_bytes())):
        for short in (0, 40, len(content) // 2):
            (tmp_path / name).write_bytes(content[:short])
            with pytest.raises(UnreadablePhotoError):
                read_photo(tmp_path / name)
    with pytest.raises(UnreadablePhotoError, match=r"more than ingest\.max_megapixels"):
        read_header(TELEPHONE, 1e-3)


@pytest.mark.parametrize(("library", "extra", "name"), [("pi_heif", "heic", "a.heic"), ("rawpy", "raw", "a.NEF")])
def test_a_missing_library_is_named(library: str, extra: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / name).write_bytes(TELEPHONE.read_bytes())
    with pytest.raises(UnreadablePhotoError, match=rf"pip install 'gsbake\[{extra}\]'"):
        read_header(tmp_path / name)


def test_of_raw_and_image_of_one_photo_the_image_is_taken(tmp_path: Path) -> None:
    for name in ("1.dng", "1.jpg", "2.DNG", "3.heic"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in list_photos(tmp_path)] == ["1.jpg", "2.DNG", "3.heic"]


def test_a_capture_of_both_is_ingested(tmp_path: Path, runner: Runner) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    shutil.copy(TELEPHONE, photos / "1.heic")
    for i in (2, 3):
        write_dng(photos / f"{i}.dng", np.roll(smooth(), 9 * i, 1))
    (photos / "4.cr2").write_bytes(b"broken")
    results, done = runner.ingest(photos)
    assert results["photos"] == 3 and any("4.cr2 is unreadable" in text for text in done.warnings)
    shutil.rmtree(done.out)
    (photos / "3.dng").unlink()
    with pytest.raises(BadInputError, match="2 usable photos|at least"):
        runner.ingest(photos)
