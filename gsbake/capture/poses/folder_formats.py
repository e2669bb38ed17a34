"""Which format the poses of a folder have, by its files."""

from __future__ import annotations

from pathlib import Path

_MODEL_FILES = ("cameras.bin", "cameras.txt")


def is_colmap_model(folder: Path) -> bool:
    """Whether a folder is a COLMAP sparse model (binary or text)."""
    return any((folder / name).is_file() for name in _MODEL_FILES)


def has_xmp(folder: Path) -> bool:
    """Whether a folder holds XMP files, as RealityScan writes them."""
    return any(path.suffix.lower() == ".xmp" for path in folder.iterdir())
