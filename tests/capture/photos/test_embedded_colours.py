"""Colours that files say to be coded otherwise than sRGB: profiles at 16 bits, and PQ and HLG of HDR screens."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms

from gsbake.capture.photos import icc
from gsbake.capture.photos.decode import read_header, read_photo
from gsbake.capture.photos.embedded_colours import to_srgb
from gsbake.imaging.srgb import encode_bytes
from tests.capture.conftest import Runner, picture
from tests.capture.photos.test_heic_and_raw import TELEPHONE

#: Columns of the primaries of Adobe RGB (1998) under D50, as its profile has them.
ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))


def profile(curve: bytes, primaries: tuple[tuple[float, float, float], ...] | None = None) -> bytes:
    """sRGB's profile with another name, `curve` in place of its own (at most 32 bytes), and `primaries`."""
    made = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes().replace(b"s\0R\0G\0B", b"w\0i\0d\0e")
    data, found = bytearray(made), icc.tags(made)
    assert found[b"rTRC"] == found[b"bTRC"] and len(curve) <= len(found[b"rTRC"])
    at = made.find(found[b"rTRC"])
    data[at : at + len(curve)] = curve
    for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), primaries or (), strict=False):
        entry = made.find(name)
        offset = int.from_bytes(made[entry + 4 : entry + 8], "big") + 8
        data[offset : offset + 12] = struct.pack(">3i", *(round(v * 65536) for v in column))
    return bytes(data)


def gamma(value: float) -> bytes:
    return struct.pack(">4s4xIH", b"curv", 1, round(value * 256))


def write_deep(path: Path, pixels: NDArray[np.uint16], embedded: bytes) -> Path:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.UINT16)
    data = np.frombuffer(embedded, np.uint8)
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(data)}]"), data)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(pixels)
    out.close()
    return path


def test_sixteen_bits_keep_their_steps_through_a_profile(tmp_path: Path) -> None:
    """Linear 16-bit values near black: rounded to 8 bits first, all of them would be 0 or 1 of 255."""
    dark = np.arange(0, 400, dtype=np.uint16).reshape(20, 20)
    photo = read_photo(write_deep(tmp_path / "a.tif", np.stack([dark] * 3, -1), profile(gamma(1.0))))
    assert photo.pixels.dtype == np.float32
    assert photo.pixels == pytest.approx(np.stack([dark] * 3, -1) / 65535, abs=1e-5)


@pytest.mark.parametrize(
    ("curve", "power"),
    [
        (gamma(563 / 256), 563 / 256),
        (struct.pack(">4s4xHxxi", b"para", 0, round(2.2 * 65536)), 2.2),
        (struct.pack(">4s4xHxx3i", b"para", 1, round(1.8 * 65536), 65536, 0), 1.8),
        (struct.pack(">4s4xI3H", b"curv", 3, 0, 16384, 65535), None),
    ],
)
def test_matrix_profiles_are_converted_as_by_littlecms(curve: bytes, power: float | None) -> None:
    embedded = profile(curve, ADOBE)
    coded = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    tags = {"ICCProfile": np.frombuffer(embedded, np.uint8), "ICCProfile:color_space": "RGB"}
    theirs = to_srgb(coded, tags)
    ours = to_srgb(coded.astype(np.float32) / 255, tags)
    assert theirs.dtype == np.uint8 and ours.dtype == np.float32
    assert np.abs(encode_bytes(ours).astype(int) - theirs).max() <= 2
    if power is not None:
        grey = icc.linear_light(embedded, np.full((1, 1, 3), 0.5, np.float32))
        assert grey is not None and grey == pytest.approx(0.5**power, rel=2e-3)


def test_broken_profiles_do_not_make_a_photo_unusable() -> None:
    pixels, whole = np.full((2, 2, 3), 0.5, np.float32), profile(gamma(1.0))
    for length in range(0, len(whole), 7):
        tags = {"ICCProfile": np.frombuffer(whole[:length], np.uint8), "ICCProfile:color_space": "RGB"}
        assert to_srgb(pixels, tags).shape == pixels.shape
    entries = b"".join(struct.pack(">III", k, k + 1, 1 << 31) for k in range(200))  # each tag is nearly the whole file
    overlapping = bytes(128) + struct.pack(">I", 200) + entries + bytes(1 << 20)
    tracemalloc.start()
    assert len(icc.tags(overlapping)) == 200 and tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    infinite = profile(struct.pack(">4s4xHxxi", b"para", 0, -(2 << 16)))  # black has no light by it
    assert icc.linear_light(infinite, np.zeros((1, 1, 3), np.float32)) is None


def hlg(scene: NDArray[np.float64]) -> NDArray[np.float64]:
    """HLG's signal of light relative to reference white, by BT.2100's OETF; 0.2650 of the scene's light has a signal of 75 %."""
    light = scene * 0.26496
    return np.where(light <= 1 / 12, np.sqrt(3 * light), 0.17883277 * np.log(np.maximum(12 * light - 0.28466892, 1e-9)) + 0.55991073)


def pq(screen: NDArray[np.float64]) -> NDArray[np.float64]:
    """PQ's signal of light relative to 203 cd/m², by the inverse EOTF of SMPTE ST 2084."""
    power = (screen * 203 / 10000) ** 0.1593017578125
    return np.asarray(((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375)


#: Linear sRGB to BT.2020 (BT.2087).
TO_BT2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
COLOURS = np.array([[[0.02, 0.02, 0.02], [0.2, 0.2, 0.2], [0.6, 0.3, 0.2], [0.1, 0.5, 0.2], [0.2, 0.2, 0.7], [1.0, 1.0, 1.0]]])


def png(path: Path, pixels: NDArray[Any], primaries: int, transfer: int) -> Path:
    """A PNG with a chunk cICP after its header."""
    out = oiio.ImageOutput.create(str(path))
    kind = oiio.UINT8 if pixels.dtype == np.uint8 else oiio.UINT16
    assert out.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, kind)) and out.write_image(pixels)
    out.close()
    data, body = path.read_bytes(), b"cICP" + bytes([primaries, transfer, 0, 1])
    path.write_bytes(data[:33] + struct.pack(">I", 4) + body + struct.pack(">I", zlib.crc32(body)) + data[33:])
    return path


@pytest.mark.parametrize(("transfer", "curve"), [(18, hlg), (16, pq)])
@pytest.mark.parametrize("bits", [8, 16])
def test_photos_for_hdr_screens(tmp_path: Path, transfer: int, curve: Any, bits: int) -> None:
    """The light that the signal stands for, in primaries of sRGB, with reference white as 1; brighter light stays brighter."""
    signal = curve(np.concatenate([COLOURS, 2 * COLOURS]) @ TO_BT2020.T)
    whole = 2**bits - 1
    pixels = np.rint(signal * whole).astype(np.uint8 if bits == 8 else np.uint16)
    photo = read_photo(png(tmp_path / "a.png", pixels, 9, transfer))
    assert photo.pixels.dtype == np.float32
    assert photo.pixels == pytest.approx(np.concatenate([COLOURS, 2 * COLOURS]), rel=0.08 if bits == 8 else 0.003, abs=0.001 + 2 / whole)


def test_other_transfers_of_png_are_srgb(tmp_path: Path) -> None:
    pixels = np.full((4, 4, 3), (10, 100, 200), np.uint8)
    assert (read_photo(png(tmp_path / "a.png", pixels, 1, 13)).pixels == pixels).all()


@pytest.mark.parametrize("name", ["http://ns.adobe.com/hdr-gain-map/1.0/", "urn:iso:std:iso:ts:21496:-1", ""])
def test_gain_maps_are_said_to_be_unused(tmp_path: Path, runner: Runner, name: str) -> None:
    """Segments of JPEG as Ultra HDR and ISO 21496-1 write them."""
    (tmp_path / "images").mkdir()
    for k in range(3):
        path = tmp_path / "images" / f"p{k}.jpg"
        Image.fromarray(picture(k)).save(path)
        data, body = path.read_bytes(), f"{name}\0".encode()
        path.write_bytes(data[:2] + b"\xff\xe2" + struct.pack(">H", len(body) + 2) + body + data[2:])
    _, done = runner.ingest(tmp_path)
    found = [w for w in done.warnings if w.startswith("3 photos have a gain map for HDR screens, which is not used (p0, p1, p2)")]
    assert len(found) == bool(name)


def ultra_hdr(path: Path, light: np.ndarray, attributes: str = "", damage: Callable[[bytes], bytes] = bytes) -> np.ndarray:
    """Write linear `light` (h, w, 3), up to 4, as Ultra HDR: tone-mapped, and a gain map of half the size; the tone-mapped light."""
    base = light / (1 + light.mean(2, keepdims=True))
    stops = np.log2((light + 1 / 64) / (base + 1 / 64)).mean(2)
    coded = np.rint(255 * np.clip(stops / 2.5, 0, 1)).astype(np.uint8)
    main, extra = io.BytesIO(), io.BytesIO()
    Image.fromarray(encode_bytes(base.astype(np.float32))).save(main, "JPEG", quality=98, subsampling=0)
    Image.fromarray(coded[::2, ::2]).save(extra, "JPEG", quality=98)
    name = b"http://ns.adobe.com/xap/1.0/\0"
    declared = 'xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"'

    def with_xmp(data: bytes, more: str) -> bytes:
        body = name + f"<rdf:Description {declared} {more}/>".encode()
        return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]

    usual = 'hdrgm:GainMapMin="0" hdrgm:GainMapMax="2.5" hdrgm:Gamma="1" hdrgm:OffsetSDR="0.015625" hdrgm:OffsetHDR="0.015625"'
    path.write_bytes(damage(with_xmp(main.getvalue(), "") + with_xmp(extra.getvalue(), attributes or usual)))
    return np.asarray(base)


def steps() -> np.ndarray:
    """Light from 0 to 4 in fields of 32 pixels, coloured in its lower half."""
    grey = np.repeat(np.repeat(np.array([[0.02, 0.2, 0.6, 0.9], [1.2, 2.0, 3.0, 4.0]]), 32, 0), 32, 1)[..., None]
    return grey * np.where(np.arange(64)[:, None, None] % 32 < 16, np.ones(3), np.array([1.0, 0.8, 0.5]))


def test_gain_maps_of_jpeg_are_applied_in_linear_light(tmp_path: Path, runner: Runner) -> None:
    light = steps()
    (tmp_path / "images").mkdir()
    for k in (2, 1, 0):
        base = ultra_hdr(tmp_path / "images" / f"p{k}.jpg", (1 - 0.2 * k) * light)
    photo = read_photo(tmp_path / "images" / "p0.jpg")
    header = read_header(tmp_path / "images" / "p0.jpg")
    assert photo.gain_map and photo.pixels.dtype == np.float32 and header.sample_bytes == 4
    inner = np.ix_(*(np.flatnonzero((np.arange(n) % 16 > 4) & (np.arange(n) % 16 < 12)) for n in light.shape[:2]))
    assert photo.pixels[inner] == pytest.approx(light[inner], rel=0.05, abs=0.01)
    assert np.abs(base[inner] - light[inner]).max() > 2  # what it was before
    _, done = runner.ingest(tmp_path)
    assert done.decisions["gain maps"][0] == "applied to 3 photos" and not [w for w in done.warnings if "gain map" in w]


@pytest.mark.parametrize(
    ("attributes", "damage"),
    [
        ('hdrgm:GainMapMax="2.5" hdrgm:BaseRenditionIsHDR="True"', bytes),
        ('hdrgm:GainMapMax="nan"', bytes),
        ('hdrgm:GainMapMax="99"', bytes),
        ('hdrgm:GainMapMax="1e39"', bytes),
        ('hdrgm:GainMapMax="1" hdrgm:GainMapMin="2"', bytes),
        ('hdrgm:GainMapMax="2,5"', bytes),
        ("", lambda data: data[:-300]),
        ("", lambda data: data.replace(b"GainMapMax", b"GainMapMix")),
    ],
)
def test_gain_maps_that_cannot_be_used_leave_the_photo(tmp_path: Path, attributes: str, damage: Callable[[bytes], bytes]) -> None:
    ultra_hdr(tmp_path / "a.jpg", steps(), attributes, damage)
    photo = read_photo(tmp_path / "a.jpg")
    assert not photo.gain_map and photo.pixels.dtype == np.uint8


def test_heic_for_hdr_screens(tmp_path: Path) -> None:
    """The same picture, said to be HLG in BT.2020: its codes stand for other light."""
    data = TELEPHONE.read_bytes()
    at = data.find(b"colrnclx") + 8
    path = tmp_path / "a.heic"
    path.write_bytes(data[:at] + struct.pack(">HH", 9, 18) + data[at + 4 :])
    photo, plain = read_photo(path), read_photo(TELEPHONE)
    header = read_header(path)
    assert photo.pixels.dtype == np.float32 and (header.channels, header.sample_bytes) == (3, 4)
    coded = plain.pixels / 255.0
    light = np.where(coded <= 0.5, coded**2 / 3, (np.exp((coded - 0.55991073) / 0.17883277) + 0.28466892) / 12) / 0.26496
    assert photo.pixels == pytest.approx(np.maximum(light @ np.linalg.inv(TO_BT2020).T, 0), abs=0.005, rel=0.01)
