"""Textures as half-float OpenEXR and environment maps as Radiance HDR, through OpenImageIO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from gsbake.errors import BadInputError

#: DateTime attribute of every file: the actual time would change the file's digest from run to run.
FIXED_DATE = "1970:01:01 00:00:00"
#: Channel names by number of channels; other counts use C0, C1, ….
CHANNEL_NAMES = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def write_exr(path: Path, image: NDArray[Any]) -> None:
    """Write `image` (h, w, c) as a half-float EXR with lossless PIZ compression; equal images give equal bytes.

    Raises OSError when it cannot be written.
    """
    height, width, channels = image.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.HALF)
    spec.channelnames = CHANNEL_NAMES.get(channels, tuple(f"C{k}" for k in range(channels)))
    spec["compression"] = "piz"
    spec["DateTime"] = FIXED_DATE
    _write(path, spec, np.ascontiguousarray(image, np.float16))


def write_hdr(path: Path, image: NDArray[Any]) -> None:
    """Write linear `image` (h, w, 3) as Radiance RGBE. Raises OSError when it cannot be written."""
    _write(path, oiio.ImageSpec(image.shape[1], image.shape[0], 3, oiio.FLOAT), np.ascontiguousarray(image, np.float32))


def _write(path: Path, spec: oiio.ImageSpec, pixels: NDArray[Any]) -> None:
    out = oiio.ImageOutput.create(str(path))
    if out is None or not out.open(str(path), spec):
        raise OSError(f"{path}: cannot be written ({oiio.geterror()}).")
    written = out.write_image(pixels)
    message = out.geterror()
    if not out.close() or not written:
        raise OSError(f"{path}: cannot be written ({message}).")


def read_exr(path: Path) -> NDArray[np.float32]:
    """Read an EXR as (h, w, c) float32. Raises BadInputError for a missing or damaged file."""
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise BadInputError(f"{path} is not a readable image ({oiio.geterror()}); bake again.")
    pixels = source.read_image(oiio.FLOAT)
    spec = source.spec()
    source.close()
    if pixels is None:
        raise BadInputError(f"{path} is damaged; bake again.")
    return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)
