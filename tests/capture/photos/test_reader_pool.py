"""Photos that make their decoder crash, hang or take all memory are skipped or interrupt the run; they never end it with a traceback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from gsbake.capture.ingest import SUBFOLDERS, IngestOptions, ingest
from gsbake.capture.photos import reader_pool
from gsbake.capture.photos.conversion import Conversion, convert
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.reader_pool import ReaderPool
from gsbake.config.schema import Ingest
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.imaging.png import write_png
from tests.support.recorder import Recorder
from tests.support.slow import slow


def photo(path: Path, seed: int, size: tuple[int, int] = (48, 64)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8))
    return path


def conversion(path: Path, out: Path, mask: Path | None = None) -> Conversion:
    for sub in SUBFOLDERS:
        (out / sub).mkdir(parents=True, exist_ok=True)
    return Conversion(path, path.name, path.stem, out, True, mask, False, 40, 250.0)


@pytest.fixture
def hurt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_pool, "READER", "tests.capture.photos.hurt_reader")


def test_a_process_gives_what_a_call_gives(tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    write_png(mask, np.full((48, 64), 255, np.uint8))
    for name, seed, own in (("a", 1, None), ("b\udcff\n", 2, None), ("c", 3, mask)):
        path = photo(tmp_path / f"{name}.png", seed)
        here = what_happens(lambda path=path, own=own: convert(conversion(path, tmp_path / "here", own)))  # type: ignore[misc]
        with ReaderPool(1) as pool:
            there = what_happens(lambda path=path, own=own: pool.convert(conversion(path, tmp_path / "there", own)))  # type: ignore[misc]
        assert here == there
    for file in (tmp_path / "here").rglob("*.png"):
        assert file.read_bytes() == (tmp_path / "there" / file.relative_to(tmp_path / "here")).read_bytes()
    written = sorted(p.relative_to(tmp_path / "there").as_posix() for p in (tmp_path / "there").rglob("*.png"))
    assert written == ["full_masks/c.png", "masks/c.png", "originals/a.png", "originals/c.png", "photos/a.png", "photos/c.png"]


def what_happens(call: object) -> object:
    try:
        done = call()  # type: ignore[operator]
    except UnreadablePhotoError as error:
        return str(error)
    return done.entry, done.orientation, done.quality.halving_loss, done.quality.thumbnail.tolist()


def test_photos_that_crash_their_decoder_are_skipped(tmp_path: Path, hurt: None) -> None:
    names = ["a", "segfault", "b", "abort_1", "abort_2", "c", "bomb", "d"]
    for k, name in enumerate(names):
        photo(tmp_path / "in" / f"{name}.png", k)
    out, recorder = tmp_path / "out", Recorder()
    out.mkdir()
    result = ingest(tmp_path / "in", out, IngestOptions(Ingest()), threads=2, monitor=recorder)
    listed = json.loads((out / "photos.json").read_text())
    assert [p["name"] for p in listed["photos"]] == ["a", "b", "c", "d"] and result["skipped"] == 4
    assert {s["source"]: s["why"] for s in listed["skipped"]} == {
        "segfault.png": "its decoder was ended by SIGSEGV",
        "abort_1.png": "its decoder was ended by SIGABRT",
        "abort_2.png": "its decoder was ended by SIGABRT",
        "bomb.png": "decoding it takes too much memory",
    }
    assert sum("was skipped" in text for text in recorder.warnings) == 4
    assert not [p for p in psutil.Process().children(recursive=True) if "hurt_reader" in " ".join(p.cmdline())]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("killed", "was ended by SIGKILL"),
        slow("hangs", "took longer than 2 s"),
        slow("exits", "ended with exit code 3"),
    ],
)
def test_what_says_nothing_about_the_photo_interrupts(
    tmp_path: Path, hurt: None, monkeypatch: pytest.MonkeyPatch, name: str, says: str
) -> None:
    """Killed by the system, too slow on a busy machine: the photo is not stored as unreadable."""
    monkeypatch.setattr(reader_pool, "MIN_SECONDS", 2.0)
    for k, other in enumerate(["a", "b", "c", name]):
        photo(tmp_path / "in" / f"{other}.png", k)
    (tmp_path / "out").mkdir()
    begin = time.monotonic()
    with pytest.raises(InterruptedRun, match=f"read the photo {name}.png {says}; run the same command"):
        ingest(tmp_path / "in", tmp_path / "out", threads=2)
    assert time.monotonic() - begin < 60


def test_a_mask_that_crashes_its_decoder_is_named(tmp_path: Path, hurt: None) -> None:
    mask = photo(tmp_path / "masks" / "abort.png", 1)
    with ReaderPool(1) as pool:
        with pytest.raises(BadInputError, match=r"The mask .*abort\.png of photo a\.png cannot be read \(.* ended by SIGABRT\)"):
            pool.convert(conversion(photo(tmp_path / "a.png", 2), tmp_path / "out", mask))
        with pytest.raises(UnreadablePhotoError, match="SIGSEGV"):  # here the photo is at fault
            pool.convert(conversion(photo(tmp_path / "segfault.png", 2), tmp_path / "out", photo(tmp_path / "masks" / "b.png", 3)))
        assert pool.convert(conversion(photo(tmp_path / "b.png", 4), tmp_path / "out")).entry["name"] == "b"


def test_a_folder_that_cannot_be_written_is_an_error_of_the_disk(tmp_path: Path) -> None:
    what = conversion(photo(tmp_path / "a.png", 1), tmp_path / "out")
    (tmp_path / "out" / "photos").rmdir()
    with ReaderPool(1) as pool, pytest.raises(FileNotFoundError):
        pool.convert(what)


def test_readers_end_with_their_parent(tmp_path: Path) -> None:
    photo(tmp_path / "hangs.png", 1)
    code = f"""
from pathlib import Path
from gsbake.capture.photos import reader_pool
from tests.capture.photos.test_reader_pool import conversion
reader_pool.READER = "tests.capture.photos.hurt_reader"
reader_pool.ReaderPool(1).convert(conversion(Path({str(tmp_path / "hangs.png")!r}), Path({str(tmp_path / "out")!r})))
"""
    parent = subprocess.Popen([sys.executable, "-c", code])
    deadline, readers = time.monotonic() + 60, []
    while not readers and time.monotonic() < deadline:
        readers = [p for p in psutil.Process(parent.pid).children() if "hurt_reader" in " ".join(p.cmdline())]
        time.sleep(0.1)
    assert readers
    time.sleep(1.0)
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    assert not psutil.wait_procs(readers, timeout=20)[1]
