"""Encoded images of glTF files, decoded in a child, and arrays in NumPy's format: damaged, or with headers that state something else."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import strategies as st

from gsbake.errors import BadInputError
from gsbake.imaging.encoded import image_size
from gsbake.imaging.image_process import read_image
from gsbake.imaging.ktx2 import available, encode_ktx2
from gsbake.imaging.npy import read_npy
from tests.fuzz.harness import damaged, edges, fuzz, outcome


def seeds() -> list[bytes]:
    """The same small picture in each format."""
    pixels = np.random.default_rng(0).integers(0, 255, (12, 8, 4), dtype=np.uint8)
    forms = [(".png", pixels), (".png", pixels[..., 0].astype(np.uint16) * 257), (".jpg", pixels[..., :3]), (".webp", pixels)]
    out = [cv2.imencode(suffix, picture)[1].tobytes() for suffix, picture in forms]
    out += [cv2.imencode(".webp", pixels[..., :3], [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()]
    return [*out, encode_ktx2(pixels[..., :3], "uastc", 50, srgb=True)] if available() else out


def test_encoded_images(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 1 << 29)
    good = seeds()
    assert all((image_size(content, "a").width, image_size(content, "a").height) == (8, 12) for content in good)

    def check(content: bytes) -> object:
        size = outcome(lambda: image_size(content, "a"), BadInputError)
        pixels = outcome(lambda: read_image(content, "a"), BadInputError)
        assert pixels is None or (size is not None and pixels.ndim == 3 and pixels.shape[2] == 4 and pixels.dtype == np.uint8)
        return pixels

    fuzz(capsys, "images of glTF files", st.one_of(damaged(good, 2), damaged(good), st.binary(max_size=60)), check)


def test_arrays(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbake.memory_budget.available_memory", lambda: 1 << 29)
    file = io.BytesIO()
    np.save(file, np.arange(12, dtype=np.float32).reshape(3, 4))
    good, path = file.getvalue(), tmp_path / "a.npy"

    def header(shape: list[int], kind: str) -> bytes:
        text = repr({"descr": kind, "fortran_order": False, "shape": tuple(shape)}).encode()
        text += b" " * ((-(10 + len(text) + 1)) % 64) + b"\n"
        return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(48)

    def check(data: bytes) -> object:
        path.write_bytes(data)
        return outcome(lambda: read_npy(path), ValueError, BadInputError)

    kinds = st.sampled_from(["<f4", ">f8", "|u1", "|O", "<U4", "<c8", "|V8", "<M8[s]", "?", "", "f4,f4"])
    headers = st.builds(header, st.lists(st.one_of(st.integers(0, 5), edges), max_size=4), kinds)
    fuzz(capsys, "NumPy arrays", st.one_of(damaged([good], 2), headers, st.binary(max_size=80)), check)
