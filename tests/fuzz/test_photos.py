"""Photos of strangers through the limited reader: headers and bodies of PNG, JPEG, TIFF, EXR, WebP, HEIC and DNG, EXIF, colour profiles."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import strategies as st
from PIL import Image, ImageCms

from gsbake.capture.ingest import SUBFOLDERS
from gsbake.capture.photos.conversion import Conversion, ConvertedPhoto
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.reader_pool import ReaderPool
from gsbake.errors import BadInputError
from tests.capture.photos.test_heic_and_raw import TELEPHONE
from tests.fuzz.harness import damaged, edges, fuzz, numbers_of_bytes, outcome
from tests.support.dng import write_dng

#: Largest edge of a working photo, and most megapixels: a damaged header must not cost seconds.
MAX_SIZE, MEGAPIXELS = 16, 0.25
#: Types of EXIF values (TIFF 6.0, section 2) and tags that the reader looks at: orientation, maker, model, focal lengths, resolution, size.
TYPES = (1, 2, 3, 4, 5, 7, 9, 10, 11, 12, 0, 99)
TAGS = (0x0112, 0x010F, 0x0110, 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002, 0xA003, 0x8769, 0x8825, 0x927C)


def pixels(channels: int, dtype: type = np.uint8) -> np.ndarray[tuple[int, ...], np.dtype[np.generic]]:
    return np.random.default_rng(1).integers(0, 255, (18, 24, channels)).astype(dtype)


def encoded(tmp_path: Path, suffix: str, array: np.ndarray[tuple[int, ...], np.dtype[np.generic]], **attributes: object) -> bytes:
    path = tmp_path / f"seed.{suffix}"
    out = oiio.ImageOutput.create(str(path))
    kind = {np.dtype(np.uint8): oiio.UINT8, np.dtype(np.uint16): oiio.UINT16}.get(array.dtype, oiio.FLOAT)
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], kind)
    for name, value in attributes.items():
        spec.attribute(name, value)
    assert out.open(str(path), spec)
    out.write_image(array)
    out.close()
    return path.read_bytes()


def with_checksums(data: bytes) -> bytes:
    """The PNG with checksums that fit its chunks, so that what is inside gets read."""
    out, at = bytearray(data[:8]), 8
    while at + 8 <= len(data):
        size = min(int.from_bytes(data[at : at + 4], "big"), len(data) - at - 8)
        chunk = data[at + 4 : at + 8 + size]
        out += data[at : at + 4] + chunk + zlib.crc32(chunk).to_bytes(4, "big")
        at += 12 + size
    return bytes(out)


def dng(path: Path) -> bytes:
    write_dng(path, np.tile(pixels(3, np.float64) / 255, (3, 3, 1)))  # LibRaw takes smaller ones for damaged
    return path.read_bytes()


@pytest.fixture
def pool() -> Iterator[ReaderPool]:
    with ReaderPool(1) as readers:
        yield readers


def fuzz_photos(
    capsys: pytest.CaptureFixture[str], title: str, folder: Path, pool: ReaderPool, suffix: str, inputs: st.SearchStrategy[bytes]
) -> None:
    """Each photo is converted or unreadable; crashes of a decoder count as unreadable, exceptions that nothing expects do not."""
    for sub in SUBFOLDERS:
        (folder / "out" / sub).mkdir(parents=True, exist_ok=True)
    path = folder / f"a.{suffix}"
    what = Conversion(path, path.name, "a", folder / "out", True, None, False, MAX_SIZE, MEGAPIXELS)

    def check(data: bytes) -> ConvertedPhoto | None:
        path.write_bytes(data)
        done = outcome(lambda: pool.convert(what), UnreadablePhotoError, BadInputError)
        if done is not None:
            focal = done.entry["focal_px"]
            assert 1 <= done.orientation <= 8 and max(done.entry["width"], done.entry["height"]) <= MAX_SIZE
            assert np.isfinite([done.quality.blur, done.quality.exposure, 1.0 if focal is None else focal]).all()
            assert done.entry["camera_model"] is not None
        return done

    fuzz(capsys, title, inputs, check)


def test_png(tmp_path: Path, pool: ReaderPool, capsys: pytest.CaptureFixture[str]) -> None:
    profile = io.BytesIO()
    Image.fromarray(pixels(3)).save(profile, "PNG", icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes())
    seeds = [encoded(tmp_path, "png", pixels(3)), encoded(tmp_path, "png", pixels(4, np.uint16)), profile.getvalue()]
    files = damaged(seeds)
    fuzz_photos(capsys, "PNG", tmp_path, pool, "png", st.one_of(files, files.map(with_checksums)))


@pytest.mark.parametrize("suffix", ["jpg", "tif", "exr", "webp", "heic", "dng"])
def test_other_formats(tmp_path: Path, pool: ReaderPool, capsys: pytest.CaptureFixture[str], suffix: str) -> None:
    seeds = {
        "jpg": lambda: [encoded(tmp_path, "jpg", pixels(3), Orientation=6, Make="m"), encoded(tmp_path, "jpg", pixels(1))],
        "tif": lambda: [encoded(tmp_path, "tif", pixels(3)), encoded(tmp_path, "tif", pixels(4, np.float32), compression="zip")],
        "exr": lambda: [
            encoded(tmp_path, "exr", pixels(4, np.float32)),
            encoded(tmp_path, "exr", pixels(3, np.float32), compression="piz"),
        ],
        "webp": lambda: [encoded(tmp_path, "webp", pixels(3))],
        "heic": lambda: [TELEPHONE.read_bytes()],
        "dng": lambda: [dng(tmp_path / "seed.dng")],
    }[suffix]()
    fuzz_photos(capsys, suffix.upper(), tmp_path, pool, suffix, st.one_of(damaged(seeds), damaged(seeds), st.binary(max_size=100)))


def exif() -> st.SearchStrategy[bytes]:
    """EXIF blocks of tags that the reader looks at, with types, counts and values that no camera writes."""
    entry = st.tuples(
        st.sampled_from(TAGS),
        st.sampled_from(TYPES),
        st.one_of(st.integers(0, 4), edges),
        st.one_of(numbers_of_bytes(), st.binary(max_size=4)),
    )

    def build(first: list[tuple[int, int, int, bytes]], second: list[tuple[int, int, int, bytes]], data: bytes) -> bytes:
        blocks, at = b"", 8
        for number, entries in enumerate((first, second)):
            packed = [struct.pack("<HHI", tag, kind, count % 2**32) + value[:4].ljust(4, b"\0") for tag, kind, count, value in entries]
            if number == 0:  # the pointer to the second block, in which EXIF's own tags stand
                packed.append(struct.pack("<HHII", 0x8769, 4, 1, 8 + 2 + 12 * (len(entries) + 1) + 4))
            block = struct.pack("<H", len(packed)) + b"".join(packed) + struct.pack("<I", 0)
            blocks, at = blocks + block, at + len(block)
        return b"Exif\0\0II*\0" + struct.pack("<I", 8) + blocks + data

    return st.builds(build, st.lists(entry, max_size=4), st.lists(entry, max_size=6), st.binary(max_size=60))


def test_exif(tmp_path: Path, pool: ReaderPool, capsys: pytest.CaptureFixture[str]) -> None:
    jpeg = encoded(tmp_path, "jpg", pixels(3))
    tags = Image.Exif()
    tags[0x010F], tags[0x0112], tags[0x0110] = "maker", 6, "model"
    tags.get_ifd(0x8769).update({0x920A: 35.0, 0xA405: 52, 0xA20E: 4000.0, 0xA210: 3, 0xA002: 24})
    blocks = st.one_of(exif(), damaged([tags.tobytes()]))
    files = blocks.map(lambda block: jpeg[:2] + b"\xff\xe1" + struct.pack(">H", min(len(block) + 2, 0xFFFF)) + block[:0xFFFD] + jpeg[2:])
    fuzz_photos(capsys, "EXIF", tmp_path, pool, "jpg", files)
