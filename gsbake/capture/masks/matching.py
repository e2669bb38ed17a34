"""Matching of mask files to photos by file name.

A photo `a.jpg` takes `masks/a.png` (any image format), else `masks/a.jpg.png` (COLMAP's convention), else its own alpha channel.
White is the object; `--invert-masks` inverts mask files (alpha is never inverted).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsbake.capture.photos.decode import MAX_MEGAPIXELS, Bytes, RawPhoto, UnreadablePhotoError, apply_orientation, read_mask
from gsbake.capture.sources import list_masks
from gsbake.errors import BadInputError


def match_masks(folder: Path, photos: dict[str, Path]) -> dict[str, Path]:
    """Mask file of each photo that has one.

    `photos` maps a photo's path inside the photo folder, in POSIX form ("a.jpg", "left/a.jpg"), to its file. Raises BadInputError when a
    mask matches no photo or two masks match one photo.
    """
    by_stem: dict[str, str] = {}
    by_name: dict[str, str] = {}
    for relative in photos:
        by_name[relative] = relative
        by_stem[relative.rsplit(".", 1)[0]] = relative
    found: dict[str, Path] = {}
    unmatched = []
    for name in list_masks(folder):
        path, stem = folder / name, name.rsplit(".", 1)[0]
        photo = by_name.get(stem) or by_stem.get(stem)
        if photo is None:
            unmatched.append(name)
        elif photo in found:
            raise BadInputError(f"The photo {photo} has two masks in {folder}, {found[photo].name} and {path.name}; remove one.")
        else:
            found[photo] = path
    if unmatched:
        names = ", ".join(unmatched[:3]) + (f" and {len(unmatched) - 3} more" if len(unmatched) > 3 else "")
        raise BadInputError(f"In {folder} no photo belongs to {names}; name masks after their photos (a.png or a.jpg.png for a.jpg).")
    return found


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
