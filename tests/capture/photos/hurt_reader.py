"""A reader process whose decoder does what the name of the photo or mask says: crashes, takes all memory, hangs, is killed."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.photos import conversion, reader_process

_READ_PHOTO, _READ_MASK = conversion.read_photo, conversion.read_mask


def _hurt(path: Path) -> None:
    match path.stem.partition("_")[0]:
        case "segfault":
            ctypes.string_at(0)
        case "abort":
            os.abort()
        case "bomb":
            np.ones(40 << 30, np.uint8)
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "hangs":
            time.sleep(1000)
        case "exits":
            os._exit(3)


def _read_photo(path: Path, *rest: Any) -> Any:
    _hurt(path)
    return _READ_PHOTO(path, *rest)


def _read_mask(path: Path, *rest: Any) -> Any:
    _hurt(path.with_name(path.name.rpartition("-")[2]))
    return _READ_MASK(path, *rest)


def main() -> None:
    conversion.read_photo, conversion.read_mask = _read_photo, _read_mask
    os.write(1, b"a library that prints\n")
    reader_process.main()
