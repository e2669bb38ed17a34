"""Frames of a video become photos: spread along the motion, the sharpest of each stretch; hostile videos end in a sentence."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.ingest import IngestOptions, ingest
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.hdr import linear_light
from gsbake.capture.photos.video import FrameMeasures, choose, frames, measure, write_frames
from gsbake.capture.photos.video_transfer import video_transfer
from gsbake.capture.sources import discover
from gsbake.config.schema import Ingest
from gsbake.errors import BadInputError
from gsbake.imaging.srgb import decode
from tests.support.slow import slow


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


def tagged(path: Path, primaries: int, transfer: int, matrix: int) -> Path:
    """A copy of an MP4 of `write_video` whose only track says how its colours are coded (the box colr)."""
    data, at, end = bytearray(path.read_bytes()), 0, path.stat().st_size
    box = struct.pack(">I4s4sHHHB", 19, b"colr", b"nclx", primaries, transfer, matrix, 0)
    around = []
    for kind, before in (*((k, 0) for k in (b"moov", b"trak", b"mdia", b"minf", b"stbl")), (b"stsd", 8), (b"mp4v", 78)):
        while data[at + 4 : at + 8] != kind:
            at += int.from_bytes(data[at : at + 4], "big")
            assert at < end, kind
        around.append(at)
        end = at + int.from_bytes(data[at : at + 4], "big")
        at += 8 + before
    for place in around:
        data[place : place + 4] = (int.from_bytes(data[place : place + 4], "big") + len(box)).to_bytes(4, "big")
    copy = path.with_name(f"{transfer}.mp4")
    copy.write_bytes(bytes(data[:end]) + box + bytes(data[end:]))
    return copy


def even(folder: Path, colours: list[tuple[int, int, int]]) -> Path:
    """Two frames of each even colour (r, g, b)."""
    writer = cv2.VideoWriter(str(folder / "even.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25, (64, 64))
    for colour in colours:
        for _ in range(2):
            writer.write(np.full((64, 64, 3), colour[::-1], np.uint8))
    writer.release()
    return folder / "even.mp4"


@pytest.mark.parametrize("transfer", [slow(16), 18])
def test_hdr_transfers_are_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transfer: int) -> None:
    """The light that BT.2100 says, of the scene for HLG and of a screen for PQ, in primaries of sRGB; reference white is white.

    This holds for the FFmpeg in OpenCV's wheel, which converts part of the way and takes seconds to prepare for it: one pass is left out.
    """
    monkeypatch.setattr("gsbake.capture.photos.video.measure", lambda *_: FrameMeasures(np.ones(12), np.ones(12)))
    greys = [(level, level, level) for level in (60, 100, 140, 250)]
    path = even(tmp_path, [*greys, (120, 105, 100), (100, 110, 120)])
    (tmp_path / "plain").mkdir()
    (tmp_path / "out").mkdir()
    assert write_frames(path, tmp_path / "plain", 100, 10.0) == (12, 12, "")
    assert write_frames(tagged(path, 9, transfer, 6), tmp_path / "out", 100, 10.0)[2] == {16: "PQ", 18: "HLG"}[transfer]

    def read(folder: str) -> NDArray[np.float64]:
        """Colours (n, 3) of the frames."""
        files = sorted((tmp_path / folder).iterdir())[1::2]
        return np.array([np.asarray(cv2.imread(str(file)))[32, 32, ::-1] for file in files]) / 255.0

    shown = linear_light(read("plain"), transfer, 9).clip(0, 1)
    allowed = 0.008 + (0.05 if transfer == 18 else 0.09) * shown  # a step of PQ in 8 bits is 4 % of the light
    assert (np.abs(decode(read("out")) - shown) < allowed).all()
    assert not (np.abs(decode(read("plain")) - shown) < allowed).all()  # the signal, taken for sRGB


def test_a_video_says_how_it_is_coded(tmp_path: Path) -> None:
    path = even(tmp_path, [(50, 50, 50)])
    assert video_transfer(path) is None
    for code in (1, 16, 18):
        assert video_transfer(tagged(path, 9, code, 9)) == code
    whole = tagged(path, 9, 18, 9).read_bytes()
    cut = tmp_path / "cut.mp4"
    for length in range(0, len(whole), 37):  # damaged files end in an answer
        cut.write_bytes(whole[:length])
        assert video_transfer(cut) in (None, 18)


def test_a_hostile_video_says_nothing(tmp_path: Path) -> None:
    """Boxes that lie one in the other thousands of times, and sizes that lead beyond all files."""
    nested = b""
    for _ in range(3000):
        nested = struct.pack(">I4s", 8 + len(nested), b"trak") + nested
    path = tmp_path / "a.mp4"
    for content in (struct.pack(">I4s", 8 + len(nested), b"moov") + nested, struct.pack(">I4sQ", 1, b"free", (1 << 62) - 1) * 5):
        path.write_bytes(content)
        assert video_transfer(path) is None


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
