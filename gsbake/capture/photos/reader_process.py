"""The child process that decodes untrusted photos and masks: see `limited_process`.

Decoders are native code: a file may make one loop, take all memory or crash. Here it does so alone, and under a limit on memory that
follows from the size that the file's header states. The parent's side is `reader_pool.py`.
"""

from __future__ import annotations

from typing import Any

import cv2
import OpenImageIO as oiio

from gsbake.capture.photos.conversion import Conversion, convert, needed_bytes
from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.errors import BadInputError
from gsbake.limited_process import limit_memory, serve
from gsbake.memory_budget import child_limit

#: Bytes that reading may take beyond what the pixels need: buffers of the decoders, stacks of threads, what the allocator reserves.
SPARE_MEMORY = 1 << 30


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """The bytes that conversion needs for the task "size", the converted photo for "convert".

    Errors: {"unreadable": reason} for the photo, {"refused": sentence} for its mask, {"os_error": [number, text, file]} for the output.
    """
    what = Conversion.from_json(request["what"])
    limit_memory(child_limit(int(request["bytes"]), SPARE_MEMORY))
    try:
        if request["task"] == "size":
            return {"bytes": needed_bytes(what)}
        done = convert(what)
    except UnreadablePhotoError as error:
        return {"unreadable": str(error)}
    except BadInputError as error:
        return {"refused": str(error)}
    except MemoryError:
        return {"unreadable": "decoding it takes too much memory"}
    except OSError as error:
        return {"os_error": [error.errno, error.strerror, str(error.filename or what.out)]}
    quality = {"blur": done.quality.blur, "exposure": done.quality.exposure, "halving_loss": done.quality.halving_loss}
    return {"entry": done.entry, "orientation": done.orientation, "quality": quality | {"thumbnail": done.quality.thumbnail.tolist()}}


def main() -> None:
    """Answer requests until the parent closes the pipe; one thread, because the parent runs several of these."""
    cv2.setNumThreads(1)
    oiio.attribute("threads", 1)
    serve(answer)
