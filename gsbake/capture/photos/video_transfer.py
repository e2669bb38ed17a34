"""The transfer function of a video by its container: the box `colr` of MP4 and MOV (ISO/IEC 14496-12; Apple, *QuickTime File Format*)."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

#: Largest description of tracks that is read, and most boxes beside it.
MAX_DESCRIPTION, MAX_BOXES = 64 << 20, 1000
#: Boxes on the way to the description of samples, and bytes before the boxes of a video's sample.
_CONTAINERS, _VIDEO_SAMPLE = (b"trak", b"mdia", b"minf", b"stbl"), 78


def video_transfer(path: Path) -> int | None:
    """The transfer's code of H.273, such as 16 for PQ and 18 for HLG; None where the file has none, or is no MP4 or MOV."""
    try:
        return next(_transfers(description, 0, len(description)), None) if (description := _description(path)) else None
    except struct.error:  # a file that ends early; its decoder says so
        return None


def _description(path: Path) -> bytes:
    """Content of the box `moov`; empty where there is none."""
    with path.open("rb") as file:
        whole = os.fstat(file.fileno()).st_size
        for _ in range(MAX_BOXES):
            header = file.read(16)
            if len(header) < 8:
                break
            size, kind = struct.unpack_from(">I4s", header)
            start = 8
            if size == 1 and len(header) == 16:
                (size,), start = struct.unpack_from(">Q", header, 8), 16
            file.seek(start - len(header), 1)
            if kind == b"moov":
                return file.read(min(size - start, MAX_DESCRIPTION)) if size > start else b""
            if size < start or size > whole:
                break
            file.seek(size - start, 1)
    return b""


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the content of each box between two places."""
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, start)
        if size < 8:
            return
        yield kind, start + 8, min(start + size, end)
        start += size


def _transfers(data: bytes, start: int, end: int, containers: Sequence[bytes] = _CONTAINERS) -> Iterator[int]:
    """Codes in the descriptions of samples inside these boxes, which lie in `containers`, one in the other."""
    for kind, first, last in _boxes(data, start, end):
        if containers and kind == containers[0]:
            yield from _transfers(data, first, last, containers[1:])
        elif not containers and kind == b"stsd":
            for _, sample, sample_end in _boxes(data, first + 8, last):
                for inner, colour, _ in _boxes(data, sample + _VIDEO_SAMPLE, sample_end):
                    if inner == b"colr" and data[colour : colour + 4] in (b"nclx", b"nclc"):
                        yield struct.unpack_from(">H", data, colour + 6)[0]
