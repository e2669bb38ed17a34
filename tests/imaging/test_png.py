"""PNGs decoded by OpenCV, without ancillary chunks; errors when a file cannot be written."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.imaging.png import encode_fast, encode_png, write_png


@pytest.mark.parametrize("shape", [(1, 1, 3), (5, 7, 3), (64, 33, 3), (9, 16), (9, 16, 1), (6, 5, 4)])
def test_opencv_reads_the_same_pixels(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    kinds = rng.integers(0, 256, shape, np.uint8), np.cumsum(np.ones(shape, np.uint8), 0, np.uint8), np.full(shape, 7, np.uint8)
    fast = [encode_fast] if len(shape) == 2 or shape[2] == 3 else []
    for pixels, encode in product(kinds, [encode_png, *fast]):
        data = encode(pixels)
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        order = [2, 1, 0, 3][: shape[2]] if len(shape) == 3 and shape[2] > 1 else None
        assert found is not None and np.array_equal(found.reshape(shape) if order is None else found[..., order], pixels)
        chunk_types = [data[i + 4 : i + 8] for i in chunks(data)]
        assert set(chunk_types) == {b"IHDR", b"IDAT", b"IEND"}


def chunks(data: bytes) -> list[int]:
    """Offsets of the chunks of a PNG."""
    out, at = [], 8
    while at < len(data):
        out.append(at)
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return out


def test_a_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError):
        write_png(tmp_path / "none" / "a.png", np.zeros((2, 2, 3), np.uint8))
