"""Conversion of one photo and its mask to working files, with quality measures. Imports little: it runs in the reader processes.

A photo that is larger than the working size is kept too, as it is, and its mask at its size: `originals` reads them.
"""

from __future__ import annotations

import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from blake3 import blake3

from gsbake.capture.photos.decode import (
    MAX_MEGAPIXELS,
    Bytes,
    RawPhoto,
    UnreadablePhotoError,
    apply_orientation,
    read_header,
    read_mask,
    read_photo,
    to_working_size,
)
from gsbake.capture.photos.exif import camera_body, camera_key, flash_fired, focal_pixels, gps_position, light_exposure, written_size
from gsbake.capture.photos.hdr import has_gain_map
from gsbake.capture.photos.heic_and_raw import HEIC_SUFFIXES
from gsbake.capture.photos.quality import Quality, measure_quality
from gsbake.errors import BadInputError
from gsbake.imaging.png import encode_fast, write_png

#: Folders of the photos that are larger than the working size, and of their masks; largest longer side that is read of them.
ORIGINALS, FULL_MASKS = "originals", "full_masks"
FULL_SIZE = 16_384


@dataclass(frozen=True)
class Conversion:
    """What to convert: the photo's file, its path `relative` to the photo folder and its `name`; its mask file (`use_mask` without one: its
    alpha channel); the folder `out` of the working files; whether to `keep` what is larger than them."""

    path: Path
    relative: str
    name: str
    out: Path
    use_mask: bool
    mask: Path | None
    invert_mask: bool
    max_size: int
    max_megapixels: float
    keep: bool = True

    def to_json(self) -> dict[str, Any]:
        """The fields in JSON types."""
        return {key: str(value) if isinstance(value, Path) else value for key, value in asdict(self).items()}

    @staticmethod
    def from_json(fields: dict[str, Any]) -> Conversion:
        """What `to_json` made."""
        mask = None if fields["mask"] is None else Path(fields["mask"])
        return Conversion(**{**fields, "path": Path(fields["path"]), "out": Path(fields["out"]), "mask": mask})


@dataclass(frozen=True)
class ConvertedPhoto:
    """A photo whose working files are written: its entry of photos.json, its EXIF orientation and its quality."""

    entry: dict[str, Any]
    orientation: int
    quality: Quality


def needed_bytes(what: Conversion) -> int:
    """Bytes that converting the photo and its mask needs, from headers. Raises UnreadablePhotoError for the photo; the mask comes later."""
    size = read_header(what.path, what.max_megapixels).needed_bytes(what.max_size)
    if what.mask is not None:
        with suppress(UnreadablePhotoError):
            size += read_header(what.mask, what.max_megapixels).needed_bytes(what.max_size)
    return size


def read_photo_mask(
    photo: RawPhoto, name: str, mask_file: Path | None, invert: bool, max_megapixels: float = MAX_MEGAPIXELS
) -> Bytes | None:
    """The mask (h, w) of a decoded photo at the photo's size, 255 = object, or None.

    A mask made for the stored photo, before its EXIF orientation, is rotated with it.
    Raises BadInputError when the mask is unreadable or differs in size from its photo.
    """
    if mask_file is None:
        return photo.alpha
    try:
        mask, mask_orientation = read_mask(mask_file, max_megapixels)
    except UnreadablePhotoError as error:
        raise BadInputError(f"The mask {mask_file} of photo {name} cannot be read ({error}); replace or remove it.") from error
    size = (photo.width, photo.height)
    if (mask.shape[1], mask.shape[0]) != size and photo.orientation >= 5 and mask_orientation == 1 and mask.shape == size:
        mask = np.asarray(apply_orientation(mask, photo.orientation), np.uint8)
    if (mask.shape[1], mask.shape[0]) != size:
        raise BadInputError(
            f"The mask {mask_file} has {mask.shape[1]}x{mask.shape[0]} pixels but its photo {name} has {size[0]}x{size[1]}; "
            "make masks at the size of the photos."
        )
    return np.asarray(255 - mask if invert else mask, np.uint8)


def convert(what: Conversion) -> ConvertedPhoto:
    """Write the working files. Raises UnreadablePhotoError for the photo, BadInputError for its mask."""
    photo = read_photo(what.path, what.max_megapixels)
    mask = read_photo_mask(photo, what.relative, what.mask, what.invert_mask, what.max_megapixels) if what.use_mask else None
    full_mask = mask
    rgb, mask = to_working_size(photo, mask, what.max_size)
    height, width = rgb.shape[:2]
    quality = measure_quality(rgb, mask)
    content = encode_fast(rgb)
    (what.out / "photos" / f"{what.name}.png").write_bytes(content)
    larger = what.keep and (width, height) != (photo.width, photo.height)
    if mask is not None:
        write_png(what.out / "masks" / f"{what.name}.png", mask)
    focal = focal_pixels(photo.tags, photo.width, photo.height)
    entry = {
        "name": what.name,
        "file": f"photos/{what.name}.png",
        "mask": None if mask is None else f"masks/{what.name}.png",
        "width": width,
        "height": height,
        "digest": blake3(content).hexdigest(),
        "original": keep_original(what, photo) if larger else None,
        "full_mask": keep_full_mask(what, full_mask) if larger and full_mask is not None else None,
        "source": what.relative,
        "source_width": photo.width,
        "source_height": photo.height,
        "focal_px": None if focal is None else focal * max(width, height) / max(photo.width, photo.height),
        "camera_model": camera_key(photo.tags),
        "camera_body": camera_body(photo.tags),
        "written_size": written_size(photo.tags),
        "gain_map": "applied" if photo.gain_map else "not used" if has_gain_map(what.path) else None,
        "flash": flash_fired(photo.tags),
        "light_exposure": light_exposure(photo.tags),
        "gps": gps_position(photo.tags),
        "blur": quality.blur,
        "exposure": quality.exposure,
        "duplicate_of": None,
    }
    return ConvertedPhoto(entry, photo.orientation, quality)


def keep_original(what: Conversion, photo: RawPhoto) -> str:
    """Keep a photo that is larger than its working photo; the name of its file.

    It is a copy of the user's file. What is read as linear light (RAW, EXR, HDR) is kept in 8-bit sRGB, since such files are larger, and
    slow to develop; those of telephones (HEIC, gain maps) are not, since they are much smaller.
    """
    suffix = what.path.suffix.lower()
    if photo.pixels.dtype == np.uint8 or photo.gain_map or suffix in HEIC_SUFFIXES:
        name = f"{ORIGINALS}/{what.name}{suffix}"
        shutil.copyfile(what.path, what.out / name)
    else:
        name = f"{ORIGINALS}/{what.name}.png"
        write_png(what.out / name, to_working_size(photo, None, FULL_SIZE)[0])
    return name


def keep_full_mask(what: Conversion, mask: Bytes) -> str:
    """Write a mask (h, w) at the size of the photo; the name of its file."""
    name = f"{FULL_MASKS}/{what.name}.png"
    write_png(what.out / name, mask)
    return name


def halve(out: Path, entry: dict[str, Any]) -> None:
    """Rewrite a working photo and its mask at half the size, remove what is larger, and update `entry`."""
    bgr: Any = cv2.imread(str(out / entry["file"]), cv2.IMREAD_COLOR)
    full = np.ascontiguousarray(bgr[..., ::-1])
    mask: Any = None if entry["mask"] is None else cv2.imread(str(out / entry["mask"]), cv2.IMREAD_GRAYSCALE)
    before = max(entry["width"], entry["height"])
    rgb, mask = to_working_size(RawPhoto(full, None, 1, {}), mask, before // 2)
    write_png(out / entry["file"], rgb)
    entry["digest"] = file_digest(out / entry["file"])
    for larger in ("original", "full_mask"):
        if entry[larger] is not None:
            (out / entry[larger]).unlink()
            entry[larger] = None
    if mask is not None:
        write_png(out / entry["mask"], mask)
    entry["height"], entry["width"] = rgb.shape[:2]
    if entry["focal_px"] is not None:
        entry["focal_px"] *= max(rgb.shape[:2]) / before


def file_digest(path: Path) -> str:
    """BLAKE3 digest of a working photo; none of one that is missing."""
    return blake3(path.read_bytes()).hexdigest() if path.exists() else ""
