"""Radiance files: what is written reads back, and what cannot be written is an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsbake.imaging.exr import read_exr, write_hdr


def test_hdr_file(tmp_path: Path) -> None:
    image = np.random.default_rng(1).exponential(3.0, (16, 32, 3)).astype(np.float32)
    write_hdr(tmp_path / "light.hdr", image)
    # RGBE shares one exponent: 8 bits of the largest channel.
    assert (np.abs(read_exr(tmp_path / "light.hdr") - image) <= image.max(axis=-1, keepdims=True) / 128).all()


def test_a_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="cannot be written"):
        write_hdr(tmp_path / "none" / "light.hdr", np.ones((2, 4, 3)))
