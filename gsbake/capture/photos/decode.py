"""Decoding of a photo in any supported format to upright 8-bit sRGB at the working size.

OpenImageIO reads JPEG, PNG, TIFF, EXR and WebP in 8 bit, 16 bit and float; `heic_and_raw` reads HEIC and RAW. Integer files are
sRGB-coded, or converted from their embedded ICC profile (16-bit ones before they are rounded), or coded for HDR screens, which is undone;
float files (EXR, float TIFF) and RAW are linear. Downsampling is an area filter
on linear values (IEC 61966-2-1 curve), weighted with alpha, because the mean of coded values is not the radiance that a larger sensor
cell measures.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from gsbake.capture.photos import heic_and_raw
from gsbake.capture.photos.embedded_colours import to_srgb
from gsbake.capture.photos.gain_map import SUFFIXES as GAIN_MAP_SUFFIXES
from gsbake.capture.photos.gain_map import read_gain_map
from gsbake.capture.photos.hdr import has_gain_map
from gsbake.imaging.srgb import decode_bytes, encode_bytes

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

#: Default of `ingest.max_megapixels`.
MAX_MEGAPIXELS = 250.0
#: Bytes per pixel of the conversion of colours that are not 8-bit, of that from another profile, and of the filter per pixel of its result
#: and of the rows between its two passes.
CONVERSION_BYTES, PROFILE_BYTES, RESULT_BYTES, ROW_BYTES = 36, 12, 40, 16
#: Rows that are converted to linear colours at once.
_BLOCK_ROWS = 64
#: Largest edge in pixels and most channels of an image that is decoded at all.
_MAX_EDGE, _MAX_CHANNELS = 100_000, 16
#: Alpha (of 255) below which the colour of a pixel is undefined.
_MIN_ALPHA = 1
#: Radius in pixels of the dilation of object colours into the background, so that no filter reads undefined colours.
_DILATION_RADIUS = 8


class UnreadablePhotoError(Exception):
    """The file cannot be decoded or is truncated; the message states the reason."""


@dataclass(frozen=True)
class RawPhoto:
    """A decoded, upright photo: `pixels` (h, w, 3) 8-bit sRGB or 32-bit linear, `alpha` (h, w) 8-bit or None, and its metadata;
    `gain_map`, whether one was applied."""

    pixels: Bytes | Floats
    alpha: Bytes | None
    orientation: int
    tags: dict[str, Any]
    gain_map: bool = False

    @property
    def width(self) -> int:
        """Width in pixels after the EXIF orientation was applied."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Height in pixels after the EXIF orientation was applied."""
        return int(self.pixels.shape[0])


def apply_orientation(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """The upright image of a stored image (h, w[, c]) with this EXIF orientation (1..8)."""
    if orientation in (5, 6, 7, 8):
        image = np.swapaxes(image, 0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


@dataclass(frozen=True)
class ImageHeader:
    """Size of a stored image from its header: width, height, channels, and bytes per channel after decoding (1 or 4)."""

    width: int
    height: int
    channels: int
    sample_bytes: int

    @property
    def megapixels(self) -> float:
        """Pixels in millions."""
        return self.width * self.height / 1e6

    def needed_bytes(self, max_size: int) -> int:
        """Bytes that decoding and reduction to `max_size` hold at once: the pixels and a copy, and what converts their colours."""
        width, height = working_size(self.width, self.height, max_size)
        filtered = 0 if width == self.width else ROW_BYTES * width * self.height + RESULT_BYTES * width * height
        each = 2 * self.channels * self.sample_bytes + (PROFILE_BYTES if self.sample_bytes == 1 else CONVERSION_BYTES)
        return self.width * self.height * each + filtered


@contextmanager
def _failures_as_unreadable() -> Iterator[None]:
    """Raise UnreadablePhotoError for whatever a decoder raises: damaged files cause exceptions of many types."""
    try:
        yield
    except UnreadablePhotoError:
        raise
    except heic_and_raw.MissingReaderError as error:
        raise UnreadablePhotoError(str(error)) from None
    except MemoryError:
        raise UnreadablePhotoError("decoding it takes too much memory") from None
    except Exception as error:
        raise UnreadablePhotoError(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}") from error


def read_header(path: Path, max_megapixels: float = MAX_MEGAPIXELS) -> ImageHeader:
    """The header of an image file; no pixel is decoded. Raises UnreadablePhotoError, also for more than `max_megapixels`."""
    with _failures_as_unreadable():
        if _is_developed(path):
            return _checked(ImageHeader(*heic_and_raw.upright_size(path)), max_megapixels)
        handle = _open(path)
        try:
            header = _header(handle.spec(), max_megapixels)
        finally:
            handle.close()
        brightened = path.suffix.lower() in GAIN_MAP_SUFFIXES and has_gain_map(path)
        return replace(header, sample_bytes=4) if brightened else header


def _is_developed(path: Path) -> bool:
    return path.suffix.lower() in heic_and_raw.SUFFIXES


def _header(spec: oiio.ImageSpec, max_megapixels: float) -> ImageHeader:
    if spec.depth > 1:
        raise UnreadablePhotoError(f"it is a volume of {spec.depth} layers")
    return _checked(ImageHeader(spec.width, spec.height, spec.nchannels, 1 if spec.format == oiio.UINT8 else 4), max_megapixels)


def _checked(header: ImageHeader, max_megapixels: float) -> ImageHeader:
    if not (0 < header.width <= _MAX_EDGE and 0 < header.height <= _MAX_EDGE and 0 < header.channels <= _MAX_CHANNELS):
        raise UnreadablePhotoError(f"it has {header.width}x{header.height} pixels of {header.channels} channels")
    if header.megapixels > max_megapixels:
        raise UnreadablePhotoError(
            f"it has {header.megapixels:.0f} megapixels, more than ingest.max_megapixels = {max_megapixels:g}; raise that setting"
        )
    return header


def _open(path: Path) -> Any:
    try:
        name = os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise UnreadablePhotoError("its name is not valid UTF-8; rename it") from None
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    handle = oiio.ImageInput.open(name, config)
    if handle is None:
        raise UnreadablePhotoError(" ".join(oiio.geterror().split()) or "unknown format")
    return handle


def _decode(path: Path, max_megapixels: float) -> tuple[NDArray[Any], oiio.ImageSpec]:
    handle = _open(path)
    try:
        spec = handle.spec()
        _header(spec, max_megapixels)
        pixels = handle.read_image(oiio.UINT8 if spec.format == oiio.UINT8 else oiio.FLOAT)
        if pixels is None or handle.has_error:  # a truncated JPEG is decoded as far as it goes, with an error set
            raise UnreadablePhotoError(" ".join(handle.geterror().split())[:200] or "no pixels")
        return pixels, spec
    finally:
        handle.close()


def read_photo(path: Path, max_megapixels: float = MAX_MEGAPIXELS) -> RawPhoto:
    """Decode a photo: grey and CMYK are converted to RGB, alpha is separated and the EXIF orientation applied.

    Raises UnreadablePhotoError when the file is broken, truncated, larger than `max_megapixels`, or holds NaN or infinite values.
    """
    with _failures_as_unreadable():
        return _read_developed(path, max_megapixels) if _is_developed(path) else _read_photo(path, max_megapixels)


def _tags(spec: oiio.ImageSpec) -> dict[str, Any]:
    """The metadata of a file by name, without entries that cannot be decoded."""
    tags: dict[str, Any] = {}
    for k in range(len(spec.extra_attribs)):
        with suppress(Exception):
            entry = spec.extra_attribs[k]
            tags[entry.name] = entry.value
    return tags


def _orientation(value: object) -> int:
    """EXIF orientation 1..8; 1 for anything else."""
    try:
        number = int(value)  # type: ignore[call-overload]
    except (TypeError, ValueError, OverflowError):
        return 1
    return number if 1 <= number <= 8 else 1


def _read_developed(path: Path, max_megapixels: float) -> RawPhoto:
    _checked(ImageHeader(*heic_and_raw.upright_size(path)), max_megapixels)
    photo = heic_and_raw.develop(path)
    pixels: Any = photo.pixels if photo.pixels.ndim == 3 else photo.pixels[..., None]
    colour: Any = np.ascontiguousarray(pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, 2))
    alpha: Any = pixels[..., 3] if pixels.shape[2] == 4 else None
    if photo.hdr is not None:
        whole = np.iinfo(colour.dtype).max
        colour = to_srgb(colour / np.float32(whole), {"CICP": photo.hdr})
        alpha = None if alpha is None else np.rint(alpha * (255.0 / whole)).astype(np.uint8)
    if alpha is not None and alpha.min() == 255:
        alpha = None
    if photo.icc_profile:
        profile = {"ICCProfile": np.frombuffer(photo.icc_profile, np.uint8), "ICCProfile:color_space": "RGB"}
        colour = to_srgb(colour, profile)
    return RawPhoto(colour, alpha, 1, photo.tags)


def _read_photo(path: Path, max_megapixels: float) -> RawPhoto:
    pixels, spec = _decode(path, max_megapixels)
    tags = _tags(spec)
    names = [str(n).upper() for n in spec.channelnames]
    alpha_at = spec.alpha_channel if spec.alpha_channel >= 0 else (names.index("A") if "A" in names else -1)
    colour_at = [i for i in range(pixels.shape[2]) if i != alpha_at]
    if not colour_at:
        raise UnreadablePhotoError("it has no colour channels")
    if all(n in names for n in "RGB"):
        colour_at = [names.index(n) for n in "RGB"]
    colour_at = colour_at[:3] if len(colour_at) >= 3 else [colour_at[0]] * 3
    colour = pixels[..., :3] if colour_at == [0, 1, 2] else pixels[..., colour_at]
    alpha = None if alpha_at < 0 else pixels[..., alpha_at]
    if pixels.dtype == np.float32:
        if not np.isfinite(colour).all():
            raise UnreadablePhotoError("it holds NaN or infinite values")
        linear = spec.format in (oiio.FLOAT, oiio.HALF, oiio.DOUBLE)
        if linear and alpha is not None and path.suffix.lower() == ".exr":  # EXR stores colour multiplied by alpha
            colour = colour / np.maximum(alpha, 1e-4)[..., None]
        if not linear:
            colour = to_srgb(colour, tags)
        if alpha is not None:
            alpha = np.rint(np.clip(alpha, 0, 1) * 255).astype(np.uint8)
    else:
        colour = to_srgb(colour, tags)
    gain_map = read_gain_map(path, colour.shape[0] * colour.shape[1]) if colour.dtype == np.uint8 else None
    if gain_map is not None:
        colour = gain_map.apply(np.asarray(colour, np.uint8))
    orientation = _orientation(tags.get("Orientation", 1))
    if alpha is not None:
        alpha = None if alpha.min() == 255 else apply_orientation(alpha, orientation)  # an opaque alpha channel is no mask
    return RawPhoto(apply_orientation(colour, orientation), alpha, orientation, tags, gain_map is not None)


def read_mask(path: Path, max_megapixels: float = MAX_MEGAPIXELS) -> tuple[Bytes, int]:
    """A mask file as (h, w) 8-bit, 255 = white, and its EXIF orientation, which is already applied.

    The mask of an RGBA file is its alpha channel unless that is opaque. Raises UnreadablePhotoError.
    """
    with _failures_as_unreadable():
        pixels, spec = _decode(path, max_megapixels)
    orientation = _orientation(spec.get_int_attribute("Orientation", 1))
    plane = pixels[..., 0]
    if spec.alpha_channel >= 0 and float(pixels[..., spec.alpha_channel].min()) < (255 if pixels.dtype == np.uint8 else 1.0):
        plane = pixels[..., spec.alpha_channel]
    if plane.dtype != np.uint8:
        plane = np.rint(np.clip(plane, 0, 1) * 255).astype(np.uint8)
    return apply_orientation(plane, orientation), orientation


def working_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Size with the longer side at most `max_size`; never larger than the source."""
    longer = max(width, height)
    if longer <= max_size:
        return width, height
    return max(1, round(width * max_size / longer)), max(1, round(height * max_size / longer))


def to_working_size(photo: RawPhoto, mask: Bytes | None, max_size: int) -> tuple[Bytes, Bytes | None]:
    """The photo as 8-bit sRGB (h, w, 3) at the working size, and the mask at that size.

    Colours are weighted with alpha in the filter, and replaced where alpha = 0, see `fill_transparent`.
    """
    size = working_size(photo.width, photo.height, max_size)
    reduced = size != (photo.width, photo.height)
    pixels: Any = photo.pixels
    weight = photo.alpha
    if reduced:
        alpha: Any = None if weight is None else weight.astype(np.float32)[..., None] / 255

        def linear_rows(rows: slice) -> Any:
            linear = decode_bytes(pixels[rows]) if pixels.dtype == np.uint8 else pixels[rows]
            return linear if alpha is None else linear * alpha[rows]

        linear = _area_mean(linear_rows, photo.height, size)
        if alpha is not None:
            reduced_alpha = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)[..., None]
            linear = linear / np.maximum(reduced_alpha, 1e-4)
            weight = np.rint(reduced_alpha[..., 0] * 255).astype(np.uint8)
        rgb = encode_bytes(linear)
    elif pixels.dtype == np.uint8:
        rgb = np.asarray(pixels)
    else:
        rgb = np.concatenate([encode_bytes(pixels[rows]) for rows in _row_blocks(photo.height)])
    if weight is not None:
        rgb = fill_transparent(rgb, weight)
    if mask is not None and reduced:
        mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(rgb, np.uint8), None if mask is None else np.ascontiguousarray(mask, np.uint8)


def _area_mean(rows_of: Callable[[slice], Any], height: int, size: tuple[int, int]) -> Floats:
    """The area filter's reduction to `size` (width, height) of an image whose rows `rows_of` gives in single precision, block by block."""
    rows = [cv2.resize(block, (size[0], len(block)), interpolation=cv2.INTER_AREA) for block in map(rows_of, _row_blocks(height))]
    return np.asarray(cv2.resize(np.concatenate(rows), size, interpolation=cv2.INTER_AREA), np.float32)


def _row_blocks(height: int) -> Iterator[slice]:
    return (slice(start, min(start + _BLOCK_ROWS, height)) for start in range(0, height, _BLOCK_ROWS))


def fill_transparent(rgb: Bytes, alpha: Bytes) -> Bytes:
    """Replace the colour of pixels with alpha = 0: dilated object colours within _DILATION_RADIUS, black beyond.

    The stored colours there (often white, or remains of an editor) would bleed into the object in every later filter.
    """
    transparent = alpha < _MIN_ALPHA
    if not transparent.any() or transparent.all():
        return rgb
    distance, labels = cv2.distanceTransformWithLabels(
        transparent.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(int(labels.max()) + 1, np.int64)
    opaque = np.flatnonzero(~transparent)
    nearest[labels.ravel()[opaque]] = opaque
    out = rgb.reshape(-1, 3)[nearest[labels.ravel()]].reshape(rgb.shape)
    out[distance > _DILATION_RADIUS] = 0
    return out
