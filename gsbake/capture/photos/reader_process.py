"""The child process that decodes untrusted photos and masks: see `limited_process`. It converts them, or reads one that is kept.

Decoders are native code: a file may make one loop, take all memory or crash. Here it does so alone, and under a limit on memory that
follows from the size that the file's header states. The parent's sides are `reader_pool` and `originals`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio

from gsbake.capture.photos.conversion import Conversion, convert, needed_bytes
from gsbake.capture.photos.decode import UnreadablePhotoError, read_header, read_photo, to_working_size
from gsbake.errors import BadInputError
from gsbake.limited_process import limit_memory, serve
from gsbake.memory_budget import budget, child_limit

#: Bytes that reading may take beyond what the pixels need: buffers of the decoders, stacks of threads, what the allocator reserves.
SPARE_MEMORY = 1 << 30


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """The bytes that conversion needs for the task "size", the converted photo for "convert"; see `_read` for "read".

    Errors: {"unreadable": reason} for the photo, {"refused": sentence} for its mask, {"os_error": [number, text, file]} for the output.
    """
    if request["task"] == "read":
        return _read(request)
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


def _read(request: dict[str, Any]) -> dict[str, Any]:
    """Write the pixels (h, w, 3) of the photo `path`, its longer side at most `max_size`, into the file `out` as NumPy's; {}.

    Errors are those of `read_in_child`, and "os_error" as in `answer`; `name` is what messages call the photo.
    """
    path, size, most = Path(request["path"]), int(request["max_size"]), float(request["max_megapixels"])
    limit_memory(child_limit(0, SPARE_MEMORY))
    try:
        needed = read_header(path, most).needed_bytes(size)
        if needed > budget():
            return {"needs": needed}
        limit_memory(child_limit(needed, SPARE_MEMORY))
        np.save(request["out"], to_working_size(read_photo(path, most), None, size)[0])
    except UnreadablePhotoError as error:
        return {"error": f"The original of {request['name']} cannot be read ({error}); run `gsbake ingest` again."}
    except OSError as error:
        return {"os_error": [error.errno, error.strerror, error.filename]}
    return {}


def main() -> None:
    """Answer requests until the parent closes the pipe; one thread, because the parent runs several of these."""
    cv2.setNumThreads(1)
    oiio.attribute("threads", 1)
    serve(answer)
