"""The child process that decodes untrusted videos, and its parent's side; see `reader_process` for why."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from gsbake.capture.photos.decode import UnreadablePhotoError
from gsbake.capture.photos.video import write_frames
from gsbake.errors import BadInputError, InterruptedRun
from gsbake.limited_process import ParserFailedError, ParserKilledError, ParserProcess, limit_memory, serve
from gsbake.memory_budget import budget

#: Module of the child.
READER = "gsbake.capture.photos.video_process"
#: Bytes that decoding may take, where there are as many: reference frames of 8K video in several threads.
MEMORY = 4 << 30
#: Seconds that a video may take: at least, and per byte of the file (a megabyte in ten seconds).
MIN_SECONDS, SECONDS_PER_BYTE = 600.0, 1e-5


def extract_frames(path: Path, out: Path, count: int, max_megapixels: float) -> tuple[int, int, str]:
    """Write at most `count` frames of the video at `path` into the folder `out`; what `write_frames` returns.

    Raises BadInputError for a video that cannot be decoded, OSError for the output, InterruptedRun.
    """
    request = {"path": str(path), "out": str(out), "count": count, "max_megapixels": max_megapixels}
    try:
        with ParserProcess(READER) as process:
            found = process.ask(request, MIN_SECONDS + SECONDS_PER_BYTE * path.stat().st_size)
    except ParserKilledError as error:
        raise InterruptedRun(f"The process that read the video {path} {error}; run the same command again.") from error
    except ParserFailedError as error:
        raise BadInputError(f"The video {path} cannot be decoded (its decoder {error}); convert it to MP4, or give its frames.") from error
    if "unreadable" in found:
        raise BadInputError(f"The video {path} cannot be used ({found['unreadable']}); convert it to MP4, or give its frames.")
    if "os_error" in found:
        raise OSError(*found["os_error"])
    return int(found["written"]), int(found["frames"]), str(found["transfer"])


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Write the frames; {"unreadable": reason} for the video, {"os_error": [number, text, file]} for the output."""
    limit_memory(min(MEMORY, budget()))
    try:
        count, most = int(request["count"]), float(request["max_megapixels"])
        written, total, transfer = write_frames(Path(request["path"]), Path(request["out"]), count, most)
    except UnreadablePhotoError as error:
        return {"unreadable": str(error)}
    except (MemoryError, cv2.error) as error:
        return {"unreadable": f"decoding it failed: {' '.join(str(error).split())[:200] or 'out of memory'}"}
    except OSError as error:
        return {"os_error": [error.errno, error.strerror, str(error.filename or request["out"])]}
    return {"written": written, "frames": total, "transfer": transfer}


def main() -> None:
    """Answer requests until the parent closes the pipe."""
    serve(answer)
