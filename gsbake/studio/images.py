"""Photos at the size of the page, made once: decoded by the limited reader processes, as any photo is, and kept as JPEG in the cache."""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from blake3 import blake3

from gsbake.atomic import write_atomic
from gsbake.capture.photos.conversion import Conversion
from gsbake.capture.photos.decode import MAX_MEGAPIXELS, UnreadablePhotoError
from gsbake.capture.photos.reader_pool import ReaderPool
from gsbake.errors import BadInputError
from gsbake.studio.workspace import Capture

#: Longer side in pixels of a photo on the contact sheet, and of one that fills the page.
SMALL, LARGE = 360, 1600
#: Quality of JPEG, and grey behind transparent photos.
QUALITY, GREY = 86, 200
#: Reader processes, and seconds without a request after which they end.
READERS, IDLE = 2, 30.0


@dataclass(frozen=True)
class Shown:
    """A photo as the page has it: JPEG file and the size of photo and picture in pixels; with `mask` the PNG of its mask at that size."""

    file: Path
    width: int
    height: int
    source_width: int
    source_height: int
    mask: Path | None = None


class Images:
    """Makes the pictures; its processes start with the first one and end when idle."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ReaderPool | None = None
        self._users = 0
        self._timer: threading.Timer | None = None

    def picture(self, capture: Capture, name: str, size: int, mask: Path | None = None, invert: bool = False) -> Shown:
        """A photo of a capture with at most `size` pixels a side, with its mask file or alpha channel as mask. Raises NotFoundError for
        another name, BadInputError for a photo or mask that cannot be decoded."""
        path = capture.photo(name)
        key = _key(path, size, mask, invert)
        files = [capture.cache / "images" / f"{key}{ending}" for ending in (".jpg", ".mask.png", ".json")]
        with suppress(OSError, ValueError, TypeError):
            sizes = json.loads(files[2].read_bytes())
            if files[0].is_file():
                return Shown(files[0], **sizes["size"], mask=files[1] if sizes["mask"] else None)
        return self._make(path, name, size, mask, invert, files)

    def close(self) -> None:
        """End the processes."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            if self._pool is not None and not self._users:
                self._pool.__exit__()
                self._pool = None

    def _make(self, path: Path, name: str, size: int, mask: Path | None, invert: bool, files: list[Path]) -> Shown:
        with tempfile.TemporaryDirectory(prefix="gsbake-studio-") as scratch, self._reader() as reader:
            for folder in ("photos", "masks"):
                Path(scratch, folder).mkdir()
            try:
                what = Conversion(path, name, "photo", Path(scratch), True, mask, invert, size, MAX_MEGAPIXELS, keep=False)
                done = reader.convert(what)
            except UnreadablePhotoError as error:
                raise BadInputError(f"The photo {name} cannot be read ({error}).") from error
            pixels: Any = cv2.imread(str(Path(scratch, "photos/photo.png")), cv2.IMREAD_COLOR)
            cover = Path(scratch, "masks/photo.png")
            if mask is None and done.entry["mask"]:  # transparent
                alpha: Any = cv2.imread(str(cover), cv2.IMREAD_GRAYSCALE)
                pixels = np.rint(GREY + (pixels - float(GREY)) * (alpha[..., None] / 255)).astype(np.uint8)
            encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
            files[0].parent.mkdir(parents=True, exist_ok=True)
            write_atomic(files[0], encoded)
            if done.entry["mask"]:
                write_atomic(files[1], cover.read_bytes())
            sizes = {key: done.entry[key] for key in ("width", "height", "source_width", "source_height")}
            write_atomic(files[2], json.dumps({"size": sizes, "mask": bool(done.entry["mask"])}))
        return Shown(files[0], **sizes, mask=files[1] if done.entry["mask"] else None)

    @contextmanager
    def _reader(self) -> Iterator[ReaderPool]:
        """The pool, which stays while somebody uses it and a while after."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            if self._pool is None:
                self._pool = ReaderPool(READERS)
            self._users += 1
            pool = self._pool
        try:
            yield pool
        finally:
            with self._lock:
                self._users -= 1
                self._timer = threading.Timer(IDLE, self.close)
                self._timer.daemon = True
                self._timer.start()


def _key(path: Path, size: int, mask: Path | None, invert: bool) -> str:
    """What tells a picture from others: the files as they are now, and its size."""
    stats = [(str(file), (found := file.stat()).st_size, found.st_mtime_ns) for file in (path, mask) if file is not None]
    return blake3(repr((stats, size, invert)).encode(errors="backslashreplace")).hexdigest(16)
