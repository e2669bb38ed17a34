from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageCms

from gsbake.capture.photos.decode import (
    UnreadablePhotoError,
    apply_orientation,
    fill_transparent,
    read_photo,
    to_working_size,
    working_size,
)
from gsbake.capture.photos.exif import camera_key, focal_pixels, light_exposure
from gsbake.imaging.srgb import decode_bytes, encode_bytes


def save_float(path: Path, pixels: np.ndarray[Any, Any]) -> None:
    """Write with OpenImageIO, float or 16 bit."""
    kind = oiio.FLOAT if pixels.dtype == np.float32 else oiio.UINT16
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind))
    assert out.write_image(pixels)
    out.close()


def test_srgb_curve_against_the_standard() -> None:
    # IEC 61966-2-1: 188 is the coded value nearest to half of full light, and 10 lies on the linear foot.
    assert decode_bytes(np.array([0, 10, 188, 255], np.uint8)) == pytest.approx([0, 10 / 255 / 12.92, 0.5029, 1.0], abs=1e-4)
    assert encode_bytes(np.array([0.0, 0.5, 0.2140, 2.0], np.float32)).tolist() == [0, 188, 127, 255]
    every = np.arange(256, dtype=np.uint8)
    assert (encode_bytes(decode_bytes(every)) == every).all()


def test_grey_sixteen_bit_and_palette(tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 6), 77, np.uint8)).save(tmp_path / "grey.png")
    Image.fromarray(np.full((4, 6), 40000, np.uint16)).save(tmp_path / "deep.png")
    save_float(tmp_path / "deep.tif", np.full((4, 6, 3), (65535, 32768, 0), np.uint16))
    Image.fromarray(np.full((4, 6, 3), (255, 0, 0), np.uint8)).quantize(4).save(tmp_path / "palette.png")
    for name, wanted in {"grey.png": (77,) * 3, "deep.png": (156,) * 3, "deep.tif": (255, 128, 0), "palette.png": (255, 0, 0)}.items():
        photo = read_photo(tmp_path / name)
        assert photo.pixels.dtype == np.uint8 and photo.pixels.shape == (4, 6, 3) and photo.alpha is None
        assert photo.pixels[2, 3].tolist() == list(wanted), name  # 40000 / 65535 · 255 = 155.6


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
def test_cmyk(tmp_path: Path, suffix: str) -> None:
    Image.fromarray(np.full((16, 16, 4), (51, 102, 204, 51), np.uint8), "CMYK").save(tmp_path / f"c{suffix}", quality=100)
    # (1 - c)(1 - k) per channel: .8·.8, .6·.8, .2·.8 of 255
    assert read_photo(tmp_path / f"c{suffix}").pixels[8, 8] == pytest.approx([163, 122, 41], abs=2)


def test_rgba_keeps_straight_colour(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[:, :2] = (200, 100, 50, 128)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(np.full((4, 4, 4), 255, np.uint8)).save(tmp_path / "opaque.png")
    photo = read_photo(tmp_path / "a.png")
    assert photo.alpha is not None
    assert photo.pixels[0, 0].tolist() == [200, 100, 50] and photo.alpha[0].tolist() == [128, 128, 0, 0]
    assert read_photo(tmp_path / "opaque.png").alpha is None


def test_linear_float_is_coded(tmp_path: Path) -> None:
    light = np.zeros((4, 4, 4), np.float32)
    light[:] = (0.25, 0.1, 0.05, 0.5)  # EXR colour is multiplied by alpha: straight light .5, .2, .1
    save_float(tmp_path / "a.exr", light)
    rgb, _ = to_working_size(read_photo(tmp_path / "a.exr"), None, 100)
    assert rgb[1, 1].tolist() == encode_bytes(np.array([0.5, 0.2, 0.1], np.float32)).tolist() == [188, 124, 89]
    light[2, 2] = np.nan
    save_float(tmp_path / "nan.exr", light)
    with pytest.raises(UnreadablePhotoError, match="NaN"):
        read_photo(tmp_path / "nan.exr")


def test_display_p3_becomes_srgb(tmp_path: Path) -> None:
    # A colour outside sRGB's middle: the same code in a wide profile is a stronger red. Profile made from sRGB with a renamed red primary.
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    wide = bytearray(profile.replace(b"s\0R\0G\0B", b"w\0i\0d\0e"))
    at = wide.find(b"rXYZ")
    offset = int.from_bytes(wide[at + 4 : at + 8], "big") + 8
    wide[offset : offset + 12] = b"".join(int(v * 65536).to_bytes(4, "big") for v in (0.5151, 0.2412, 0.0))
    picture = Image.fromarray(np.full((8, 8, 3), (200, 60, 60), np.uint8))
    picture.save(tmp_path / "plain.png", icc_profile=profile)
    picture.save(tmp_path / "wide.png", icc_profile=bytes(wide))
    plain, converted = (read_photo(tmp_path / name).pixels[4, 4].astype(int) for name in ("plain.png", "wide.png"))
    assert plain.tolist() == [200, 60, 60]
    assert converted[0] > 205


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_as_pillow_applies_it(tmp_path: Path, orientation: int) -> None:
    from PIL import ImageOps

    pixels = np.kron(np.arange(6, dtype=np.uint8).reshape(2, 3) * 40, np.ones((8, 8), np.uint8))
    image = Image.fromarray(pixels).convert("RGB")
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / "o.jpg", exif=exif, quality=100, subsampling=0)
    with Image.open(tmp_path / "o.jpg") as stored:
        wanted = np.asarray(ImageOps.exif_transpose(stored))
    photo = read_photo(tmp_path / "o.jpg")
    assert photo.orientation == orientation
    assert (photo.pixels == wanted).all()
    assert (apply_orientation(np.asarray(stored := Image.open(tmp_path / "o.jpg")), orientation) == wanted).all()
    stored.close()


def test_truncated_and_invalid_files(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    for suffix in ("jpg", "png"):
        Image.fromarray(noise).save(tmp_path / f"whole.{suffix}")
        data = (tmp_path / f"whole.{suffix}").read_bytes()
        (tmp_path / f"cut.{suffix}").write_bytes(data[: len(data) // 2])
        with pytest.raises(UnreadablePhotoError):
            read_photo(tmp_path / f"cut.{suffix}")
    (tmp_path / "text.jpg").write_text("no photo")
    (tmp_path / "nothing.jpg").touch()
    for name in ("text.jpg", "nothing.jpg"):
        with pytest.raises(UnreadablePhotoError):
            read_photo(tmp_path / name)


def test_area_filter_works_on_linear_values(tmp_path: Path) -> None:
    board = np.zeros((64, 64, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 255
    Image.fromarray(board).save(tmp_path / "board.png")
    rgb, _ = to_working_size(read_photo(tmp_path / "board.png"), None, 16)
    assert rgb.shape == (16, 16, 3) and (rgb == 188).all()  # half the light, not half the code (128)


def test_area_filter_is_weighted_with_alpha(tmp_path: Path) -> None:
    pixels = np.zeros((32, 32, 4), np.uint8)
    pixels[..., :3] = 255
    pixels[:, ::2] = (100, 100, 100, 255)  # the other columns are transparent white
    Image.fromarray(pixels).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    rgb, mask = to_working_size(photo, photo.alpha, 16)
    assert mask is not None and (np.abs(mask.astype(int) - 128) <= 1).all()
    assert (np.abs(rgb.astype(int) - 100) <= 1).all()


def test_transparent_pixels_are_filled() -> None:
    rgb = np.full((40, 40, 3), 255, np.uint8)
    alpha = np.zeros((40, 40), np.uint8)
    rgb[:, :5], alpha[:, :5] = (10, 200, 30), 255
    out = fill_transparent(rgb, alpha)
    assert (out[:, 5:12] == (10, 200, 30)).all() and (out[:, 20:] == 0).all()


def test_working_size() -> None:
    assert working_size(4000, 3000, 1000) == (1000, 750)
    assert working_size(300, 400, 1000) == (300, 400)
    assert working_size(5000, 1, 100) == (100, 1)


def test_focal_from_exif() -> None:
    # Full-frame equivalents refer to the diagonal of 36x24 mm.
    assert focal_pixels({"Exif:FocalLengthIn35mmFilm": 50}, 3000, 2000) == pytest.approx(50 / 36 * 3000)
    assert focal_pixels({"Exif:FocalLengthIn35mmFilm": 26}, 4000, 3000) == pytest.approx(26 / math.hypot(36, 24) * 5000)
    tags = {"Exif:FocalLength": 55.0, "Exif:FocalPlaneXResolution": 5184 / 22.3, "Exif:FocalPlaneResolutionUnit": 4}
    tags["Exif:PixelXDimension"] = 5184
    assert focal_pixels(tags, 1200, 800) == pytest.approx(55 / 22.3 * 1200)
    assert focal_pixels(tags, 1200, 1200) is None  # no sensor is square: cropped
    assert focal_pixels(tags | {"Exif:PixelXDimension": 400}, 1200, 800) is None  # a "sensor" of 1.7 mm: resized without telling EXIF
    assert focal_pixels({"Exif:FocalLength": 55.0}, 1200, 800) is None
    assert focal_pixels({"Exif:FocalLengthIn35mmFilm": float("nan")}, 1200, 800) is None
    assert camera_key({"Make": "Canon", "Model": "600D ", "Exif:FocalLength": 46.0}) == "Canon 600D 46 mm"


EXPOSURE = {"ExposureTime": 0.01, "FNumber": 2.0, "Exif:PhotographicSensitivity": 400}


def test_exposure_by_the_older_name_of_the_speed() -> None:
    older = {**EXPOSURE, "Exif:PhotographicSensitivity": 0, "Exif:ISOSpeedRatings": 400}
    assert light_exposure(EXPOSURE) == pytest.approx(1) and light_exposure(older) == pytest.approx(1)


@pytest.mark.parametrize(
    "other",
    [{"FNumber": value} for value in (0, -2.0, "f/2", 1e300, 1e-300)]
    + [{"ExposureTime": value} for value in (0.0, -0.01, "1/100", float("nan"), float("inf"), 1e307)]
    + [{"Exif:PhotographicSensitivity": value} for value in (0, (400, 0), 65535)],
)
def test_strange_exposures_are_not_known(other: dict[str, object]) -> None:
    """65535 is what EXIF has for all higher speeds."""
    assert light_exposure(EXPOSURE | other) is None
