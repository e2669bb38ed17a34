"""Resampling between the texture and a coarser one of the same atlas, whose texels are about a pixel of the photos wide.

A texture finer than the photos has texels that no pixel's centre falls on. Materials are fitted on a texture smaller by a power of two and
upsampled, with the fine detail of the projected colours as a ratio.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.texels import Texels, rasterise

Floats = NDArray[np.float32]

#: Largest width of a coarse texel in pixels.
MAX_TEXEL_WIDTH = 1.5
#: Smallest coarse texture, edge in texels.
MIN_SIZE = 64
#: Detail is a ratio within this factor of 1; this offset on linear colours removes it from dark ones.
MAX_DETAIL_RATIO, DETAIL_OFFSET = 2.0, 0.004


@dataclass(frozen=True)
class CoarseTexture:
    """The `fine` and the coarse `texels` of one atlas; `edge` of a coarse texel on the surface."""

    fine: Texels
    texels: Texels
    edge: float

    @classmethod
    def of(cls, uv: NDArray[Any], faces: NDArray[Any], fine: Texels, edge: float, pixel: float) -> CoarseTexture:
        """The smallest texture of the atlas `uv` (v, 2), `faces` (f, 3) whose texels are about a `pixel` wide on the surface.

        `edge` is that of a fine texel; `pixel` and `edge` are in the same unit.
        """
        size = fine.size
        while size // 2 >= MIN_SIZE and edge * fine.size / size * 2 <= MAX_TEXEL_WIDTH * pixel:
            size //= 2
        return cls.sized(uv, faces, fine, edge, size)

    @classmethod
    def sized(cls, uv: NDArray[Any], faces: NDArray[Any], fine: Texels, edge: float, size: int) -> CoarseTexture:
        """The texture of `size`, or `fine` itself where that is no larger."""
        size = min(size, fine.size)
        texels = fine if size == fine.size else rasterise(uv, faces, size)
        return cls(fine, texels, edge * fine.size / size)

    @property
    def is_fine(self) -> bool:
        """Whether the coarse texture is the fine one."""
        return self.texels.size == self.fine.size

    def down(self, values: NDArray[Any]) -> Floats:
        """Values (n, c) of the fine texels averaged onto the coarse ones (m, c)."""
        if self.is_fine:
            return np.asarray(values, np.float32)
        size = self.texels.size
        image = fill_empty_texels(self.fine.image(values), self.fine.covered(), gutter=2 * self.fine.size // size)
        return _resize(image, size, cv2.INTER_AREA)[self.texels.index]

    def up(self, values: NDArray[Any]) -> Floats:
        """Values (m, c) of the coarse texels interpolated at the fine ones (n, c)."""
        if self.is_fine:
            return np.asarray(values, np.float32).copy()
        image = fill_empty_texels(self.texels.image(values), self.texels.covered(), gutter=4)
        return _resize(image, self.fine.size, cv2.INTER_LINEAR)[self.fine.index]

    def detail(self, colour: NDArray[Any]) -> Floats:
        """Ratio (n, c) of the fine texels' linear `colour` (n, c) to its coarse version."""
        if self.is_fine:
            return np.ones_like(colour, np.float32)
        smooth = self.up(self.down(colour))
        return np.clip((colour + DETAIL_OFFSET) / (smooth + DETAIL_OFFSET), 1 / MAX_DETAIL_RATIO, MAX_DETAIL_RATIO).astype(np.float32)


def _resize(image: Floats, size: int, interpolation: int) -> Floats:
    """`image` (s, s, c) resized to (size², c), plane by plane: OpenCV's filters take at most four channels."""
    planes = [cv2.resize(np.ascontiguousarray(image[..., c]), (size, size), interpolation=interpolation) for c in range(image.shape[2])]
    return np.asarray(np.stack(planes, 2).reshape(size * size, -1), np.float32)
