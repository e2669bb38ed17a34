"""Untrusted files: photos, pose files and COLMAP models that are broken on purpose cost one sentence each."""

from __future__ import annotations

import json
import struct
import time
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import OpenImageIO as oiio
import pytest

from gsbake.capture.ingest import IngestOptions, ingest, photo_names
from gsbake.capture.photos.decode import UnreadablePhotoError, read_header, read_photo
from gsbake.capture.poses.frames import PhotoIndex, PhotoSize
from gsbake.capture.poses.given import read_poses
from gsbake.capture.poses.validation import read_xml
from gsbake.config.schema import Ingest
from gsbake.errors import BadInputError
from gsbake.imaging.exr import write_exr
from gsbake.imaging.png import write_png
from gsbake.memory_budget import MemoryBudget
from tests.support.large_files import sparse_file
from tests.support.slow import slow

SIZES = {"a.jpg": PhotoSize(200, 100)}
POSE = np.eye(4).tolist()


def photo(path: Path, seed: int = 0) -> Path:
    write_png(path, np.random.default_rng(seed).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    return path


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_of_size(path: Path, width: int, height: int) -> Path:
    """A small valid file of one bit a pixel with many pixels."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    rows = zlib.compress(bytes(height * (1 + -(-width // 8))), 9)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b""))
    return path


def exr(path: Path, channels: list[str], **attributes: object) -> Path:
    spec = oiio.ImageSpec(8, 8, len(channels), oiio.FLOAT)
    spec.channelnames = channels
    for name, value in attributes.items():
        spec.attribute(name, value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    out.write_image(np.full((8, 8, len(channels)), 0.5, np.float32))
    out.close()
    return path


def test_exr_without_colour(tmp_path: Path) -> None:
    with pytest.raises(UnreadablePhotoError, match="no colour channels"):
        read_photo(exr(tmp_path / "a.exr", ["A"]))


def test_orientation_that_is_text(tmp_path: Path) -> None:
    assert read_photo(exr(tmp_path / "a.exr", ["R", "G", "B"], Orientation="sideways")).orientation == 1


def test_flipped_bytes_in_a_header_are_unreadable_or_read(tmp_path: Path) -> None:
    data = exr(tmp_path / "a.exr", ["R", "G", "B"], Software="test").read_bytes()
    for at in range(0, min(len(data), 400)):
        changed = bytearray(data)
        changed[at] ^= 0x80
        (tmp_path / "b.exr").write_bytes(bytes(changed))
        try:
            read_header(tmp_path / "b.exr")
            read_photo(tmp_path / "b.exr", 1.0)
        except UnreadablePhotoError as error:
            assert "\n" not in str(error)


def test_broken_colour_profile(tmp_path: Path) -> None:
    from PIL import Image

    for profile in (b"", b"nonsense", b"\0" * 200, b"acsp" * 64):
        Image.new("RGB", (8, 8), (10, 20, 30)).save(tmp_path / "a.png", icc_profile=profile)
        assert read_photo(tmp_path / "a.png").pixels[0, 0].tolist() == [10, 20, 30]


def test_image_bomb_is_refused_from_its_header(tmp_path: Path) -> None:
    bomb = png_of_size(tmp_path / "bomb.png", 20_000, 20_000)
    begin = time.monotonic()
    with pytest.raises(UnreadablePhotoError, match=r"400 megapixels, more than ingest\.max_megapixels = 250; raise that setting"):
        read_photo(bomb)
    with pytest.raises(UnreadablePhotoError):
        read_photo(png_of_size(tmp_path / "wide.png", 200_000, 1))
    assert bomb.stat().st_size < 60_000
    assert time.monotonic() - begin < 5


def test_bad_photos_are_skipped_with_their_reason(tmp_path: Path) -> None:
    folder, out = tmp_path / "photos", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    for k in range(3):
        photo(folder / f"{k}.png", k)
    png_of_size(folder / "bomb.png", 20_000, 20_000)
    exr(folder / "alpha.exr", ["A"])
    (folder / "text.jpg").write_text("not a photo")
    photo(folder / ("n" * 240 + ".png"), 7)
    photo(folder / "a\nb\x1b[31m.png", 8)
    result = ingest(folder, out, IngestOptions(Ingest()))
    listed = json.loads((out / "photos.json").read_text())
    assert result["photos"] == 5 and {s["source"] for s in listed["skipped"]} == {"bomb.png", "alpha.exr", "text.jpg"}
    assert "ingest.max_megapixels" in next(s["why"] for s in listed["skipped"] if s["source"] == "bomb.png")
    assert all(p["name"].isprintable() and len(p["name"]) < 210 for p in listed["photos"])
    (tmp_path / "few").mkdir()
    for k in range(4):
        png_of_size(tmp_path / "few" / f"{k}.png", 20_000, 20_000 + k)
    (tmp_path / "out2").mkdir()
    with pytest.raises(BadInputError, match="0 usable photos") as caught:
        ingest(tmp_path / "few", tmp_path / "out2")
    assert caught.value.exit_code == 42


def test_name_that_is_no_text(tmp_path: Path) -> None:
    relative = b"a\xff.png".decode(errors="surrogateescape")
    assert photo_names({relative: tmp_path / "x"})[relative].isascii()
    (tmp_path / relative).write_bytes(photo(tmp_path / "ok.png").read_bytes())
    with pytest.raises(UnreadablePhotoError, match="not valid UTF-8"):
        read_photo(tmp_path / relative)


def test_memory_budget_bounds_what_is_held_at_once() -> None:
    from concurrent.futures import ThreadPoolExecutor

    budget, held, most = MemoryBudget(100), [0], [0]

    def work(size: int) -> None:
        with budget.reserve(size):
            held[0] += size
            most[0] = max(most[0], held[0])
            time.sleep(0.01)
            held[0] -= size

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, [40] * 20))
    assert most[0] <= 80
    with budget.reserve(10_000):  # more than there is: alone
        pass


@pytest.mark.parametrize(
    "change",
    [
        {"fl_x": "600"}, {"fl_x": [600]}, {"fl_x": True}, {"w": float("nan")}, {"h": 0}, {"w": 0}, {"fl_x": int("9" * 400)},
        {"fl_x": 1e300},
        {"k1": 1e30}, {"cx": -1e30}, {"camera_angle_x": 4.0, "fl_x": None}, {"frames": {}}, {"frames": [[]]}, {"frames": None},
        {"frames": [{"file_path": "a.jpg", "transform_matrix": [[1e308] * 4] * 4}]},
        {"frames": [{"file_path": "a.jpg", "transform_matrix": [[1, 0, 0, 1e308], [0, 1, 0, 0], [0, 0, 1, 0]]}]},
        {"frames": [{"file_path": "a.jpg", "transform_matrix": [[1, 2], [3]]}]},
        {"frames": [{"file_path": 5, "transform_matrix": POSE}]},
        {"frames": [{"file_path": "a.jpg" * 2000, "transform_matrix": POSE}]},
    ],
)  # fmt: skip
def test_hostile_transforms(tmp_path: Path, change: dict[str, Any]) -> None:
    frames = [{"file_path": "a.jpg", "transform_matrix": POSE}]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"fl_x": 150.0, "w": 200, "h": 100, "frames": frames} | change))
    with pytest.raises(BadInputError) as caught:
        read_poses(path, ["a.jpg"], SIZES)
    assert "\n" not in str(caught.value) and "transforms.json" in str(caught.value) and len(str(caught.value)) < 6000


@pytest.mark.parametrize("data", [b"", b"\xff\xfe", b"[" * 100_000, b'{"frames":' * 1000, b"null", b"5", b'{"frames": [}'])
def test_transforms_that_are_no_transforms(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "transforms.json"
    path.write_bytes(data)
    with pytest.raises(BadInputError, match="is not a valid transforms.json"):
        read_poses(path, [], SIZES)


def npy(shape: tuple[int, ...], dtype: str = "<f8", data: bytes = b"") -> bytes:
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    header += b" " * ((-(10 + len(header) + 1)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize(
    "data",
    [
        b"", npy((10**12, 17)), npy((1, 17)), npy((1, 17), "|O", b"\x80\x04N."), npy((1, 17), "<U4", b"\0" * 272), b"PK\x03\x04zip",
        npy((-1, 17)), npy((1, 17), data=np.full((1, 17), np.nan).tobytes()), npy((1, 17), data=np.full((1, 17), 1e308).tobytes()),
    ],
)  # fmt: skip
def test_hostile_llff(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(data)
    with pytest.raises(BadInputError) as caught:
        read_poses(path, ["a.jpg"], SIZES)
    assert "\n" not in str(caught.value)


def colmap_model(folder: Path, points: bytes, name: bytes = b"a.jpg", size: int = 200, focal: float = 100.0, x: float = 0.0) -> Path:
    """A binary model of one PINHOLE camera and one image."""
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, size, 100, focal, focal, 100.0, 50.0))
    image = struct.pack("<QI7dI", 1, 1, 1.0, 0.0, 0.0, 0.0, x, 0.0, 0.0, 1) + name + b"\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(image)
    (folder / "points3D.bin").write_bytes(points)
    return folder


def test_colmap_model_by_hand(tmp_path: Path) -> None:
    given = read_poses(colmap_model(tmp_path / "sparse", struct.pack("<Q", 0)), [], SIZES)
    assert given.cameras["a.jpg"].fx == 100.0


@pytest.mark.parametrize(
    "change",
    [
        {"points": struct.pack("<Q", 2**63)}, {"focal": float("nan")},
        slow({"points": struct.pack("<Q", 2**40)}), slow({"points": b""}), slow({"name": b"\xff\xfe\x80.jpg"}), slow({"size": 0}),
        slow({"focal": 1e300}), slow({"focal": 0.0}), slow({"x": 1e308}), slow({"x": float("inf")}), slow({"size": 2**60}),
    ],
)  # fmt: skip
def test_hostile_colmap_model(tmp_path: Path, change: dict[str, Any]) -> None:
    folder = colmap_model(tmp_path / "sparse", **({"points": struct.pack("<Q", 0)} | change))
    begin = time.monotonic()
    with pytest.raises(BadInputError) as caught:
        read_poses(folder, [], SIZES)
    assert "\n" not in str(caught.value) and time.monotonic() - begin < 60


@pytest.mark.slow
def test_many_frames_are_matched_in_linear_time() -> None:
    photos = [f"{k:06d}.jpg" for k in range(20_000)]
    index = PhotoIndex(photos)
    begin = time.monotonic()
    assert all(index.match(f"images/{name}") == name for name in photos)
    assert time.monotonic() - begin < 10  # comparing all pairs takes minutes


def test_a_sparse_colmap_model_is_refused_by_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A terabyte that is not there neither lifts the limit of the reader nor is read; nor are other files of the folder."""
    monkeypatch.setattr("gsbake.capture.poses.colmap_model.read_in_child", lambda *_: pytest.fail("it is read"))
    folder = colmap_model(tmp_path / "sparse", struct.pack("<Q", 0))
    sparse_file(folder / "points3D.bin", head=struct.pack("<Q", 2**30))
    begin = time.monotonic()
    with pytest.raises(BadInputError, match=r"COLMAP model .*sparse needs 1\.6e\+04 GB of memory to be read"):
        read_poses(folder, [], SIZES)
    assert time.monotonic() - begin < 5


def test_a_colmap_models_limit_is_within_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []

    def stop(_: object, request: dict[str, Any], *__: object) -> dict[str, Any]:
        limits.append(request["memory"])
        raise BadInputError("stopped")

    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 3 << 30)
    monkeypatch.setattr("gsbake.capture.poses.colmap_model.read_in_child", stop)
    folder = colmap_model(tmp_path / "sparse", struct.pack("<Q", 0))
    sparse_file(folder / "notes.txt")  # no file of the model
    with pytest.raises(BadInputError, match="stopped"):
        read_poses(folder, [], SIZES)
    assert 2 << 30 <= limits[0] < 3 << 30


def test_a_photo_that_needs_more_memory_than_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An EXR of 16 channels: its header is enough, and the run ends with its name, for another machine may read it."""
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 400_000_000)
    folder, out = tmp_path / "photos", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    for k in range(3):
        photo(folder / f"{k}.png", k)
    write_exr(folder / "bomb.exr", np.zeros((1500, 1500, 16), np.float16))
    assert (folder / "bomb.exr").stat().st_size < 200_000
    with pytest.raises(BadInputError, match=r"The photo bomb\.exr needs 0\.369 GB of memory to be read, and 0\.3 GB may be used") as caught:
        ingest(folder, out, IngestOptions(Ingest()))
    assert caught.value.exit_code == 42


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-7", "latin-1", "utf-16-declared"]
)
def test_entities_are_refused_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    """The parser says that there is a document type, not a search for its text; what it cannot decode is no XML."""
    body = '<!DOCTYPE d [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]><document><chunk label="&b;">&b;</chunk></document>'
    name = encoding.removesuffix("-declared")
    declared = "" if name == encoding and encoding.startswith("utf-16") else f'<?xml version="1.0" encoding="{name.removesuffix("-sig")}"?>'
    path = tmp_path / "cameras.xml"
    path.write_bytes((declared + body).encode(name))
    with pytest.raises(BadInputError, match="declares XML entities|is not a valid XML file") as caught:
        read_xml(path, "file of Metashape cameras")
    assert "\n" not in str(caught.value)
    if encoding in ("utf-16", "utf-16-declared", "utf-8", "latin-1"):
        assert "declares XML entities" in str(caught.value)


def test_xml_is_read_as_the_standard_library_does(tmp_path: Path) -> None:
    text = '<a xmlns="urn:x" xmlns:p="urn:y" p:k="1"> t&amp;u <p:b j="2"/>tail<!-- c --><![CDATA[<d>]]></a>'
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "a.xml").write_bytes(text.encode(encoding))
        found = read_xml(tmp_path / "a.xml", "file")
        assert ElementTree.tostring(found) == ElementTree.tostring(ElementTree.fromstring(text))
