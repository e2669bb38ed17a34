"""Frames of a video become photos: spread along the motion, the sharpest of each stretch; hostile videos end in a sentence."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.capture.ingest import IngestOptions, ingest
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.video import FrameMeasures, choose, frames, measure
from gsbake.capture.sources import discover
from gsbake.config.schema import Ingest
from gsbake.errors import BadInputError


def write_video(path: Path, offsets: list[int], blurred: tuple[int, ...] = (), size: int = 160) -> Path:
    """A view of `size` pixels that slides over a texture by `offsets`; some frames are blurred."""
    texture = np.random.default_rng(0).integers(0, 255, (size // 4, 300, 3), np.uint8)
    texture = cv2.resize(texture, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (size, size))
    assert writer.isOpened()
    for index, offset in enumerate(offsets):
        frame = np.ascontiguousarray(texture[:size, offset : offset + size])
        writer.write(cv2.GaussianBlur(frame, (0, 0), 3) if index in blurred else frame)
    writer.release()
    return path


def test_frames_follow_the_motion() -> None:
    """Half of the frames show a camera at rest: nearly all that are chosen come from the other half, each the sharpest of its stretch."""
    motion = np.concatenate([np.zeros(50), np.ones(50)])
    sharpness = np.where(np.arange(100) % 5 == 2, 2.0, 1.0)
    chosen = choose(FrameMeasures(sharpness, motion), 10)
    assert len(chosen) == 10 and (chosen >= 50).sum() >= 9
    assert (chosen % 5 == 2).sum() >= 9
    assert (np.diff(chosen) > 0).all()


def test_a_still_film_gives_frames_evenly_in_time() -> None:
    chosen = choose(FrameMeasures(np.ones(100), np.zeros(100)), 4)
    assert len(chosen) == 4 and np.ptp(np.diff(chosen)) <= 1


def test_fewer_frames_than_asked_for_are_all_taken() -> None:
    assert choose(FrameMeasures(np.ones(3), np.array([0.0, 1.0, 9.0])), 3).tolist() == [0, 1, 2]


def test_motion_and_sharpness_are_measured(tmp_path: Path) -> None:
    """Eight pixels of 160 a frame, then rest; a blurred frame is less sharp."""
    path = write_video(tmp_path / "pan.mp4", [*range(0, 80, 8), *[72] * 6], blurred=(4,))
    found = measure(path, 100.0)
    assert np.median(found.motion[1:10]) == pytest.approx(8 / 160, rel=0.2)
    assert found.motion[11:].max() < 0.2 * 8 / 160
    assert found.sharpness[4] < 0.5 * found.sharpness[3]


def test_a_video_is_ingested_as_photos(tmp_path: Path) -> None:
    """The blurred frames are left out; no frame is left beside the working photos."""
    path = write_video(tmp_path / "pan.mp4", list(range(0, 240, 8)), blurred=tuple(range(1, 30, 3)))
    sources = discover(path)
    assert (sources.photos, sources.masks, sources.poses) == (path, None, None)
    out = tmp_path / "out"
    out.mkdir()
    options = IngestOptions(Ingest(frames=8, mask_network="none"), "keep")
    figures = ingest(path, out, options)
    assert figures["photos"] == 8
    names = [entry["name"] for entry in json.loads((out / "photos.json").read_text())["photos"]]
    assert len(set(names)) == 8 and not any(int(name[-6:]) % 3 == 1 for name in names)
    assert sorted(p.name for p in out.iterdir()) == ["photos", "photos.json"]


@pytest.mark.parametrize("damage", ["empty", "text", "cut"])
def test_a_damaged_video_is_one_sentence(tmp_path: Path, damage: str) -> None:
    """An empty file, a text, and a video without its index."""
    path = write_video(tmp_path / "pan.mp4", list(range(0, 80, 8)))
    content = path.read_bytes()
    path.write_bytes({"empty": b"", "text": b"no video at all", "cut": content[: len(content) // 2]}[damage])
    (tmp_path / "out").mkdir()
    with pytest.raises(BadInputError, match="convert it to MP4, or give its frames") as caught:
        ingest(path, tmp_path / "out", IngestOptions(Ingest(mask_network="none")))
    assert "\n" not in str(caught.value)


def test_frames_that_are_too_large_are_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "pan.mp4", [0, 8, 16])
    (tmp_path / "out").mkdir()
    with pytest.raises(BadInputError, match="more than ingest.max_megapixels"):
        ingest(path, tmp_path / "out", IngestOptions(Ingest(max_megapixels=0.01)))


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".mp4", "ffconcat version 1.0\nfile other.avi\n"),
        (".mkv", "ffconcat version 1.0\nfile 'other.avi'\ninpoint 0\n"),
        (".mp4", "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nother.avi\n#EXT-X-ENDLIST\n"),
        (".mov", "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n"),
    ],
)
def test_a_list_of_other_files_opens_none_of_them(tmp_path: Path, suffix: str, text: str) -> None:
    """FFmpeg recognises its lists by their content, whatever the file is called."""
    write_video(tmp_path / "other.avi", [0, 5, 10], size=64)
    assert len(list(frames(tmp_path / "other.avi", 1.0))) == 3
    (tmp_path / f"x{suffix}").write_text(text)
    with pytest.raises(UnreadablePhotoError, match="no MP4, MOV, AVI, MKV or WebM"):
        list(frames(tmp_path / f"x{suffix}", 1.0))
