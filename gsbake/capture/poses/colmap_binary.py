"""Check of COLMAP's binary files against their lengths: every count and every record must fit (https://colmap.github.io/format.html).

COLMAP itself reads past the end of a shortened file, takes what it finds for counts, and fills memory with them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from gsbake.errors import BadInputError

#: Number of parameters of COLMAP's camera models by their identifier.
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16, 12: 4, 13: 5, 14: 3, 15: 4, 16: 6, 17: 2}
#: No record is shorter.
MIN_RECORD = 8
_COUNT = struct.Struct("<Q")


class _ShortError(Exception):
    """A record does not fit into its file."""


class _UnknownModelError(Exception):
    """A camera model of which COLMAP knows more; it reports it."""


def check_binary_files(folder: Path) -> None:
    """Raise BadInputError for the first binary file of a model that is shorter than its records."""
    for name, walk in _WALKS.items():
        path = folder / name
        if not path.is_file():
            continue
        try:
            _walk(path.read_bytes(), walk)
        except (_ShortError, struct.error):
            raise BadInputError(f"The COLMAP model {folder} cannot be read ({name} ends before its records do); export it again.") from None
        except _UnknownModelError:
            pass


def _walk(data: bytes, record: Callable[[bytes, int], int]) -> None:
    """Go through a count, then so many records."""
    (count,) = _COUNT.unpack_from(data)
    at = _COUNT.size
    if count * MIN_RECORD > len(data):
        raise _ShortError
    for _ in range(count):
        at = record(data, at)
        if at > len(data):
            raise _ShortError


def _camera(data: bytes, at: int) -> int:
    _, model = struct.unpack_from("<Ii", data, at)
    if model not in _PARAMETERS:
        raise _UnknownModelError
    return at + 24 + 8 * _PARAMETERS[model]


def _image(data: bytes, at: int) -> int:
    end = data.find(b"\0", at + 64)
    if end < 0:
        raise _ShortError
    return end + 9 + 24 * int(_COUNT.unpack_from(data, end + 1)[0])


def _point(data: bytes, at: int) -> int:
    return at + 51 + 8 * int(_COUNT.unpack_from(data, at + 43)[0])


def _rig(data: bytes, at: int) -> int:
    _, sensors = struct.unpack_from("<II", data, at)
    at += 8 + 8 * min(sensors, 1)
    for _ in range(max(0, min(sensors - 1, len(data)))):
        posed = struct.unpack_from("<iIB", data, at)[2]
        at += 9 + 56 * bool(posed)
    return at


def _frame(data: bytes, at: int) -> int:
    return at + 68 + 16 * int(struct.unpack_from("<I", data, at + 64)[0])


_WALKS = {"cameras.bin": _camera, "images.bin": _image, "points3D.bin": _point, "rigs.bin": _rig, "frames.bin": _frame}
#: Names of the binary files of a model.
BINARY_FILES = tuple(_WALKS)
