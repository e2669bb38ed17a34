"""Matching of mask files to photos by file name.

A photo `a.jpg` takes `masks/a.png` (any image format), else `masks/a.jpg.png` (COLMAP's convention), else its own alpha channel.
Masks that the frames of a transforms.json name come first.
White is the object; `--invert-masks` inverts mask files (alpha is never inverted).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gsbake.capture.sources import list_masks
from gsbake.errors import BadInputError
from gsbake.text import missing_list


def match_masks(folder: Path, photos: Mapping[str, Path], named: Mapping[str, Path] | None = None) -> dict[str, Path]:
    """Mask file of each photo that has one.

    `photos` maps a photo's path inside the photo folder, in POSIX form ("a.jpg", "left/a.jpg"), to its file; `named` has the mask files
    that poses name, by photo: names of files tell those of other photos. Raises BadInputError when two masks match one photo, or, without
    `named`, a mask matches no photo.
    """
    named = named or {}
    taken = {path.resolve() for path in [*named.values(), *(photos.values() if named else ())]}
    by_stem: dict[str, str] = {}
    by_name: dict[str, str] = {}
    for relative in photos:
        by_name[relative] = relative
        by_stem[relative.rsplit(".", 1)[0]] = relative
    found = dict(named)
    unmatched = []
    for name in list_masks(folder):
        path, stem = folder / name, name.rsplit(".", 1)[0]
        photo = by_name.get(stem) or by_stem.get(stem)
        if photo in named or (taken and path.resolve() in taken):
            continue
        if photo is None:
            unmatched.append(name)
        elif photo in found:
            raise BadInputError(f"The photo {photo} has two masks in {folder}, {found[photo].name} and {path.name}; remove one.")
        else:
            found[photo] = path
    if unmatched and not named:
        names = missing_list(unmatched)
        raise BadInputError(f"In {folder} no photo belongs to {names}; name masks after their photos (a.png or a.jpg.png for a.jpg).")
    return found
