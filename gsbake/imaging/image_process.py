"""The child process that decodes images of files from outside, and its parent's side; see `limited_process` for why.

Textures of glTF files and maps of normals and depth (PNG, JPEG, WebP, KTX2) and lights (HDR, EXR) are parsed by native code. Here a file
that makes it crash or fill the memory costs a sentence. Sizes come from headers first, and pixels come back in a temporary file. There is
one child for all images of a process, started with the first of them: that costs about a third of a second.
"""

from __future__ import annotations

import atexit
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.imaging.encoded import as_rgba, decode_pixels, image_size
from gsbake.limited_process import ParserProcess, limit_memory, read_in_child, serve
from gsbake.memory_budget import budget, child_limit

#: Bytes that decoding may take beyond what the pixels need: buffers of the decoders, stacks of threads, what the allocator reserves.
SPARE_MEMORY = 512 << 20
#: Seconds that an image may take: at least, and per byte of memory that it needs (ten megabytes a second).
MIN_SECONDS, SECONDS_PER_BYTE = 60.0, 1e-7
#: Bytes per pixel of a light in the parent, which makes a cube map of it in double precision.
LIGHT_BYTES = 96

_child = ParserProcess(__name__)
_one_at_a_time = threading.Lock()
atexit.register(_child.close)


def read_image(content: bytes, name: str) -> NDArray[np.uint8]:
    """Pixels (h, w, 4) 8-bit RGBA of an encoded image from outside. Raises BadInputError, which names `name`."""
    return as_rgba(read_pixels(content, name), name)


def read_pixels(content: bytes, name: str) -> NDArray[Any]:
    """Pixels (h, w[, c]) of an encoded image from outside as they are stored, colours in the order BGR. Raises BadInputError."""
    needed = image_size(content, name).needed
    with tempfile.TemporaryDirectory(prefix="gsbake-image-") as scratch:
        Path(scratch, "image").write_bytes(content)
        return _ask({"task": "image", "path": str(Path(scratch, "image")), "name": name, "needed": needed}, name, needed, scratch)


def read_light(path: Path) -> NDArray[np.float32]:
    """Radiance (h, w, 3) of an HDR or EXR image from outside. Raises BadInputError."""
    with tempfile.TemporaryDirectory(prefix="gsbake-image-") as scratch:
        most = budget()
        return _ask({"task": "light", "path": str(path.absolute()), "name": f"'{path}'", "needed": most}, f"'{path}'", most, scratch)


def _ask(request: dict[str, Any], name: str, needed: int, scratch: str) -> NDArray[Any]:
    target = Path(scratch, "pixels.npy")
    with _one_at_a_time:
        read_in_child(_child, {**request, "target": str(target)}, MIN_SECONDS + SECONDS_PER_BYTE * needed, name)
    found: NDArray[Any] = np.load(target, allow_pickle=False)
    return found


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Write the pixels of the image or light in "path" to "target". Errors: {"error": sentence}, or {"needs": bytes} that are too many."""
    limit_memory(child_limit(int(request["needed"]), SPARE_MEMORY))
    path, name = Path(request["path"]), str(request["name"])
    try:
        if request["task"] == "light":
            return _light(path, name, int(request["needed"]), Path(request["target"]))
        np.save(Path(request["target"]), decode_pixels(path.read_bytes(), name))
    except BadInputError as error:
        return {"error": str(error)}
    except MemoryError:
        raise
    except Exception as error:  # bindings of native code raise what they like
        return {"error": f"{name} cannot be decoded ({' '.join(repr(error).split())[:120]})."}
    return {}


def _light(path: Path, name: str, most: int, target: Path) -> dict[str, Any]:
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    spec = None if source is None else source.spec()
    if spec is not None and (needed := spec.width * spec.height * max(1, spec.depth) * (4 * spec.nchannels + LIGHT_BYTES)) > most:
        return {"needs": needed}
    pixels = None if source is None else source.read_image(oiio.FLOAT)
    if pixels is None or pixels.ndim != 3 or pixels.shape[2] < 3 or not np.isfinite(pixels).all():
        reason = " ".join(oiio.geterror().split())[:200] or "damaged"
        raise BadInputError(f"{name} is not a readable HDR image of three channels ({reason}).")
    np.save(target, np.ascontiguousarray(pixels[..., :3], np.float32))
    return {}


def main() -> None:
    """Answer requests until the parent closes the pipe; one thread, so that memory follows from the pixels."""
    import cv2

    cv2.setNumThreads(1)
    serve(answer)
