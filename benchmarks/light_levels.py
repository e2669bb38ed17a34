"""Mean radiance of published environment maps: how bright a light is that photographers expose for.

python -m benchmarks.light_levels FOLDER [FOLDER ...]

Reads `*.exr`, `*.hdr` and the modules `*.exr.js` of the npm package @pmndrs/assets (the file as base64) in the folders, equirectangular.
Prints the mean over the sphere by luminance of each, and the median and the scale of the logarithm by which Student's t with two degrees of
freedom has their quartiles: the constants of `gsbake.materials.light_intensity`.
"""

from __future__ import annotations

import argparse
import base64
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray
from scipy import stats

from gsbake.imaging.srgb import LUMINANCE

#: File names of environment maps.
PATTERNS = ("*.exr", "*.hdr", "*.exr.js")


def environment_maps(folder: Path) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """Names and linear RGB images (h, w, 3) of the environment maps in a folder, by name."""
    for path in sorted(p for pattern in PATTERNS for p in folder.glob(pattern)):
        if path.suffix != ".js":
            yield path.name, read(path)
            continue
        found = re.search(r"base64,([A-Za-z0-9+/=]+)", path.read_text())
        if found is not None:
            with tempfile.TemporaryDirectory() as scratch:
                file = Path(scratch) / path.stem
                file.write_bytes(base64.b64decode(found[1]))
                yield path.name, read(file)


def read(path: Path) -> NDArray[np.float32]:
    """The image (h, w, 3). Raises OSError when it cannot be read."""
    image = oiio.ImageBuf(str(path))
    pixels: Any = image.get_pixels(oiio.FLOAT)
    if image.has_error or pixels is None:
        raise OSError(f"{path}: {image.geterror()}")
    return np.asarray(pixels[..., :3], np.float32)


def mean_radiance(image: NDArray[np.float32]) -> float:
    """Mean over the sphere of the luminance of an equirectangular image (h, w, 3)."""
    height = len(image)
    area = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    return float(((image @ LUMINANCE).mean(1) * area).sum() / area.sum())


def median_and_scale(values: Sequence[float]) -> tuple[float, float]:
    """Median, and scale of the logarithm by which Student's t with two degrees of freedom has the values' quartiles."""
    low, middle, high = np.quantile(np.log(values), (0.25, 0.5, 0.75))
    return float(np.exp(middle)), float((high - low) / (stats.t.ppf(0.75, 2) - stats.t.ppf(0.25, 2)))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Mean radiance of published environment maps.")
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    values = []
    for folder in parser.parse_args(arguments).folders:
        for name, image in environment_maps(folder):
            values.append(mean_radiance(image))
            sys.stdout.write(f"{values[-1]:.3f}  {name}\n")
    if not values:
        parser.error("there are no environment maps in these folders")
    median, scale = median_and_scale(values)
    sys.stdout.write(f"{len(values)} maps, median {median:.2f}, scale {scale:.2f}\n")


if __name__ == "__main__":
    main()
