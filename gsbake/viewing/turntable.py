"""Turntables: views around a scene, as a film (MP4, VP9), an animation (WebP) or a sheet (PNG)."""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbake.errors import BadInputError, UsageError
from gsbake.geometry.cameras import Camera
from gsbake.imaging.png import encode_png
from gsbake.own_files import require_new_file
from gsbake.report.render import Shader
from gsbake.viewing.render import SceneRenderer

#: Half the field of view, and elevation of the cameras, in radians.
HALF_ANGLE, ELEVATION = math.radians(15), math.radians(20)
#: Frames per second of films and animations.
FRAME_RATE = 24
#: Grey (sRGB) behind the object.
BACKGROUND = 0.86
#: Quality of the WebP animation, 0..100.
WEBP_QUALITY = 85
SUFFIXES = (".mp4", ".webp", ".png")


def orbit(centre: NDArray[np.float64], radius: float, views: int, pixels: int, elevation: float = ELEVATION) -> list[Camera]:
    """`views` square cameras of `pixels` around `centre` (3,), +Y up, the first in front (+Z); each shows a sphere of `radius`."""
    distance = radius / math.sin(HALF_ANGLE)
    focal = pixels / 2 / math.tan(HALF_ANGLE)
    cameras = []
    for view in range(views):
        azimuth = 2 * math.pi * view / views
        towards = np.array([math.cos(elevation) * math.sin(azimuth), math.sin(elevation), math.cos(elevation) * math.cos(azimuth)])
        right = np.cross(-towards, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-towards, right), -towards])
        position = centre + distance * towards
        cameras.append(Camera(f"view{view}", pixels, pixels, focal, focal, pixels / 2, pixels / 2, rotation, -rotation @ position))
    return cameras


def frames(renderer: SceneRenderer, cameras: Iterable[Camera], shader: Shader, samples: int = 2) -> Iterator[NDArray[np.uint8]]:
    """8-bit sRGB renders (h, w, 3) over the background."""
    for camera in cameras:
        yield np.asarray(np.rint(255 * renderer.draw(camera, shader, samples).over(BACKGROUND)), np.uint8)


def check_output(
    path: Path, inputs: Iterable[Path], *, overwrite: bool, what: str = "A turntable", suffixes: Sequence[str] = SUFFIXES
) -> None:
    """Raise UsageError unless the suffix is one of `suffixes`, the folder exists, and the file is none of the `inputs` and either new or to
    be replaced."""
    if path.suffix.lower() not in suffixes:
        raise UsageError(f"{what} is written as {', '.join(suffixes)}, not '{path.suffix or path}'.")
    if not path.parent.is_dir():
        raise UsageError(f"The folder '{path.parent}' does not exist.")
    require_new_file(path, inputs, overwrite=overwrite)


def write_turntable(
    path: Path, images: Iterator[NDArray[np.uint8]], progress: Callable[[int], None] = lambda done: None, *, overwrite: bool = False
) -> int:
    """Write the images in the format of the suffix of `path`; returns their number. Raises BadInputError when it cannot be written."""
    check_output(path, (), overwrite=overwrite)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix.lower()}")
    try:
        count = _write(temporary, images, progress)
        temporary.replace(path)
    except OSError as error:
        raise BadInputError(f"'{path}' cannot be written: {error.strerror or error}.") from error
    finally:
        temporary.unlink(missing_ok=True)
    return count


def sheet(images: list[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Equal images (h, w, 3) in rows of `columns`."""
    height, width = images[0].shape[:2]
    rows = -(-len(images) // columns)
    out = np.full((rows * height, columns * width, 3), round(255 * BACKGROUND), np.uint8)
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        out[row * height : (row + 1) * height, column * width : (column + 1) * width] = image
    return out


def _write(path: Path, images: Iterator[NDArray[np.uint8]], progress: Callable[[int], None]) -> int:
    if path.suffix == ".mp4":
        return _write_film(path, images, progress)
    collected = []
    for image in images:
        collected.append(image)
        progress(len(collected))
    if path.suffix == ".png":
        path.write_bytes(encode_png(sheet(collected, math.ceil(math.sqrt(len(collected))))))
    else:
        first, *rest = (Image.fromarray(image) for image in collected)
        first.save(path, "WEBP", save_all=True, append_images=rest, duration=round(1000 / FRAME_RATE), loop=0, quality=WEBP_QUALITY)
    return len(collected)


def _write_film(path: Path, images: Iterator[NDArray[np.uint8]], progress: Callable[[int], None]) -> int:
    """VP9 in MP4, which browsers play and OpenCV's FFmpeg encodes without parts under the GPL."""
    writer, count = None, 0
    for image in images:
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), FRAME_RATE, image.shape[1::-1])
            if not writer.isOpened():
                raise OSError("OpenCV has no VP9 encoder here; write a .webp")
        writer.write(np.ascontiguousarray(image[..., ::-1]))
        count += 1
        progress(count)
    if writer is not None:
        writer.release()
    return count
