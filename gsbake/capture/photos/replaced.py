"""Photos and masks that were replaced by hand: they must have the size of what they replace."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from PIL import Image

from gsbake.errors import BadInputError
from gsbake.text import missing_list

#: The chunk that ends a PNG file, and in how many of its last bytes it is looked for.
PNG_END, PNG_TAIL = b"IEND\xaeB`\x82", 1024


def require_sizes(folder: Path, sizes: Mapping[str, tuple[int, int]], stage: str) -> None:
    """Raise BadInputError, which lists them, where photos and masks in the artifact folder of a `stage` cannot be read or have other sizes
    in pixels than {name: (width, height)}. Only headers and the ends of files are read; files that are not there are not looked at."""
    wrong = []
    for name, size in sizes.items():
        for path in (folder / sub / f"{name}.png" for sub in ("photos", "masks")):
            if path.exists() and (found := _size(path)) != size:
                shown = "cannot be read" if found is None else "is {} × {}, not {} × {}".format(*found, *size)
                wrong.append(f"{path.parent.name}/{path.name} {shown}")
    if wrong:
        raise BadInputError(
            f"Replaced photos and masks of the stage {stage} must have the size in pixels of those before: {missing_list(wrong)}; give "
            f"others, or return to the stage's own with `gsbake replace {stage} --undo`."
        )


def _size(path: Path) -> tuple[int, int] | None:
    """Width and height that the header of an image states; None where there is none, or the end of a PNG is missing."""
    try:
        with path.open("rb") as file, Image.open(file) as image:
            if image.format != "PNG":
                return image.size
            file.seek(max(0, path.stat().st_size - PNG_TAIL))
            return image.size if PNG_END in file.read() else None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
