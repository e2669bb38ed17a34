"""Decoding one photo, of whatever format, to upright 8-bit sRGB of the working size.

OpenImageIO reads JPEG, PNG, TIFF, EXR and WebP in 8 bit, 16 bit and float. Integer files are taken as sRGB-coded, or converted from the ICC
profile they carry; float files (EXR, float TIFF) as linear light. Reduction is an area filter in linear light (IEC 61966-2-1 curve),
weighted with alpha, since the mean of coded values is not the light a larger sensor cell would have caught.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode_bytes, encode_bytes

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

#: Alpha below this (of 255) is background whose colour means nothing.
_CLEAR = 1
#: Colours of the object are spread this many pixels into the background, so that no filter mixes in what lay under alpha = 0.
_SPREAD = 8


class UnreadablePhotoError(Exception):
    """The file cannot be decoded, or ends too early; the message says why."""


@dataclass(frozen=True)
class RawPhoto:
    """A decoded, upright photo: `pixels` (h, w, 3) 8-bit sRGB or 32-bit linear, `alpha` (h, w) 8-bit or None, and its metadata."""

    pixels: Bytes | Floats
    alpha: Bytes | None
    orientation: int
    tags: dict[str, Any]

    @property
    def width(self) -> int:
        """Width in pixels after the EXIF orientation was applied."""
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        """Height in pixels after the EXIF orientation was applied."""
        return int(self.pixels.shape[0])


def orient(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn or mirror an image (h, w[, c]) by its EXIF orientation (1..8) so that its top is up."""
    if orientation in (5, 6, 7, 8):
        image = np.swapaxes(image, 0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def _decode(path: Path) -> tuple[NDArray[Any], oiio.ImageSpec]:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    handle = oiio.ImageInput.open(str(path), config)
    if handle is None:
        raise UnreadablePhotoError(oiio.geterror().strip() or "unknown format")
    try:
        spec = handle.spec()
        pixels = handle.read_image(oiio.UINT8 if spec.format == oiio.UINT8 else oiio.FLOAT)
        if pixels is None or handle.has_error:  # a truncated JPEG is decoded as far as it goes, with an error set
            raise UnreadablePhotoError(handle.geterror().strip().splitlines()[0] or "no pixels")
        return pixels, spec
    finally:
        handle.close()


def _from_profile(rgb: Bytes, tags: dict[str, Any]) -> Bytes:
    """Convert from the RGB profile a file carries (Display P3 of phones, Adobe RGB of cameras) to sRGB."""
    profile = tags.get("ICCProfile")
    if profile is None or "srgb" in str(tags.get("ICCProfile:profile_description", "")).lower():
        return rgb
    if not str(tags.get("ICCProfile:color_space", "")).strip().upper().startswith("RGB"):
        return rgb
    from PIL import Image, ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(np.asarray(profile).astype(np.uint8).tobytes()))
        out = ImageCms.profileToProfile(Image.fromarray(rgb), source, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except ImageCms.PyCMSError:
        return rgb  # a broken profile is no reason to lose the photo
    return rgb if out is None else np.asarray(out, np.uint8)


def read_photo(path: Path) -> RawPhoto:
    """Decode a photo: grey becomes RGB, CMYK is converted, alpha is split off and the EXIF orientation applied.

    Raises UnreadablePhotoError when the file is broken, truncated or holds values that are no numbers.
    """
    pixels, spec = _decode(path)
    tags: dict[str, Any] = {a.name: a.value for a in spec.extra_attribs}
    names = [str(n).upper() for n in spec.channelnames]
    alpha_at = spec.alpha_channel if spec.alpha_channel >= 0 else (names.index("A") if "A" in names else -1)
    colour_at = [i for i in range(pixels.shape[2]) if i != alpha_at]
    if all(n in names for n in "RGB"):
        colour_at = [names.index(n) for n in "RGB"]
    colour = pixels[..., colour_at[:3] if len(colour_at) >= 3 else [colour_at[0]] * 3]
    alpha = None if alpha_at < 0 else pixels[..., alpha_at]
    if pixels.dtype == np.float32:
        if not np.isfinite(colour).all():
            raise UnreadablePhotoError("it holds NaN or infinite values")
        linear = spec.format in (oiio.FLOAT, oiio.HALF, oiio.DOUBLE)
        if linear and alpha is not None and path.suffix.lower() == ".exr":  # EXR stores colour multiplied by alpha
            colour = colour / np.maximum(alpha, 1e-4)[..., None]
        if not linear:
            colour = np.rint(np.clip(colour, 0, 1) * 255).astype(np.uint8)
        if alpha is not None:
            alpha = np.rint(np.clip(alpha, 0, 1) * 255).astype(np.uint8)
    if colour.dtype == np.uint8:
        colour = _from_profile(np.ascontiguousarray(colour), tags)
    orientation = int(tags.get("Orientation", 1) or 1)
    if alpha is not None:
        alpha = None if alpha.min() == 255 else orient(alpha, orientation)  # an opaque alpha channel is no mask
    return RawPhoto(orient(colour, orientation), alpha, orientation, tags)


def read_mask(path: Path) -> tuple[Bytes, int]:
    """A mask file as (h, w) 8-bit, 255 = white, and its EXIF orientation, which is already applied.

    Of RGBA files the alpha channel is the mask if it is not opaque. Raises UnreadablePhotoError.
    """
    pixels, spec = _decode(path)
    orientation = spec.get_int_attribute("Orientation", 1) or 1
    plane = pixels[..., 0]
    if spec.alpha_channel >= 0 and float(pixels[..., spec.alpha_channel].min()) < (255 if pixels.dtype == np.uint8 else 1.0):
        plane = pixels[..., spec.alpha_channel]
    if plane.dtype != np.uint8:
        plane = np.rint(np.clip(plane, 0, 1) * 255).astype(np.uint8)
    return orient(plane, orientation), orientation


def working_size(width: int, height: int, max_size: int) -> tuple[int, int]:
    """Size with the longer side at most `max_size`; never larger than the source."""
    longer = max(width, height)
    if longer <= max_size:
        return width, height
    return max(1, round(width * max_size / longer)), max(1, round(height * max_size / longer))


def to_working(photo: RawPhoto, mask: Bytes | None, max_size: int) -> tuple[Bytes, Bytes | None]:
    """8-bit sRGB (h, w, 3) of the working size, and the mask at that size.

    Where the photo has alpha, its colour counts by alpha in the filter, and what lies under alpha = 0 is replaced, see `fill_clear`.
    """
    size = working_size(photo.width, photo.height, max_size)
    reduced = size != (photo.width, photo.height)
    pixels = photo.pixels
    weight = photo.alpha
    if reduced:
        linear: Any = decode_bytes(np.asarray(pixels, np.uint8)) if pixels.dtype == np.uint8 else pixels
        if weight is not None:
            share = weight.astype(np.float32)[..., None] / 255
            total = cv2.resize(share, size, interpolation=cv2.INTER_AREA)[..., None]
            linear = cv2.resize(linear * share, size, interpolation=cv2.INTER_AREA) / np.maximum(total, 1e-4)
            weight = np.rint(total[..., 0] * 255).astype(np.uint8)
        else:
            linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
        rgb = encode_bytes(linear)
    else:
        rgb = np.asarray(pixels) if pixels.dtype == np.uint8 else encode_bytes(pixels)
    if weight is not None:
        rgb = fill_clear(rgb, weight)
    if mask is not None and reduced:
        mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(rgb, np.uint8), None if mask is None else np.ascontiguousarray(mask, np.uint8)


def fill_clear(rgb: Bytes, alpha: Bytes) -> Bytes:
    """Give pixels with alpha = 0 a harmless colour: the nearest object colour close by, black farther away.

    Whatever stood there (often white, or left-overs of an editor) would otherwise bleed into the object in every later filter.
    """
    clear = alpha < _CLEAR
    if not clear.any() or clear.all():
        return rgb
    distance, labels = cv2.distanceTransformWithLabels(
        clear.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(int(labels.max()) + 1, np.int64)
    solid = np.flatnonzero(~clear)
    nearest[labels.ravel()[solid]] = solid
    out = rgb.reshape(-1, 3)[nearest[labels.ravel()]].reshape(rgb.shape)
    out[distance > _SPREAD] = 0
    return out
