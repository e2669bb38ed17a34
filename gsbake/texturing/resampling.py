"""The same atlas at a coarser size: for what photos cannot resolve texel by texel.

A texture finer than the photos has texels that no pixel's centre falls on. Fitting happens on a power-of-two smaller one whose texels are
about a pixel, and comes back enlarged, with the fine detail of what the photos show as a ratio.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.texturing.inpainting import flood
from gsbake.texturing.texels import Texels, rasterise

Floats = NDArray[np.float32]

#: Coarse texels are at most this many pixels wide.
WIDEST = 1.5
#: Smallest coarse texture.
SMALLEST = 64
#: Detail is a ratio within this factor; colours below `DARKEST` have none.
STRONGEST, DARKEST = 2.0, 0.004


@dataclass(frozen=True)
class Coarse:
    """`fine` and coarse `texels` of one atlas; `edge` of a coarse texel on the surface."""

    fine: Texels
    texels: Texels
    edge: float

    @classmethod
    def of(cls, uv: NDArray[Any], faces: NDArray[Any], fine: Texels, edge: float, pixel: float) -> Coarse:
        """The smallest texture of the atlas `uv` (v, 2), `faces` (f, 3) whose texels are about a `pixel` wide on the surface.

        `edge` is a fine texel's; `pixel` and `edge` in the same unit.
        """
        size = fine.size
        while size // 2 >= SMALLEST and edge * fine.size / size * 2 <= WIDEST * pixel:
            size //= 2
        return cls.sized(uv, faces, fine, edge, size)

    @classmethod
    def sized(cls, uv: NDArray[Any], faces: NDArray[Any], fine: Texels, edge: float, size: int) -> Coarse:
        """The texture of `size`, or `fine` itself where that is no larger."""
        size = min(size, fine.size)
        texels = fine if size == fine.size else rasterise(uv, faces, size)
        return cls(fine, texels, edge * fine.size / size)

    @property
    def same(self) -> bool:
        """Whether both are one."""
        return self.texels.size == self.fine.size

    def down(self, values: NDArray[Any]) -> Floats:
        """Values (n, c) of the fine texels averaged onto the coarse ones (m, c)."""
        if self.same:
            return np.asarray(values, np.float32)
        size = self.texels.size
        image = flood(self.fine.image(values), self.fine.covered(), rim=2 * self.fine.size // size)
        return _resized(image, size, cv2.INTER_AREA)[self.texels.index]

    def up(self, values: NDArray[Any]) -> Floats:
        """Values (m, c) of the coarse texels interpolated at the fine ones (n, c)."""
        if self.same:
            return np.asarray(values, np.float32).copy()
        image = flood(self.texels.image(values), self.texels.covered(), rim=4)
        return _resized(image, self.fine.size, cv2.INTER_LINEAR)[self.fine.index]

    def detail(self, shown: NDArray[Any]) -> Floats:
        """What `shown` (n, c) of the fine texels has beyond its coarse version: a factor (n, c)."""
        if self.same:
            return np.ones_like(shown, np.float32)
        smooth = self.up(self.down(shown))
        return np.clip((shown + DARKEST) / (smooth + DARKEST), 1 / STRONGEST, STRONGEST).astype(np.float32)


def _resized(image: Floats, size: int, how: int) -> Floats:
    """`image` (s, s, c) as (size², c); OpenCV's filters take at most four channels, so plane by plane."""
    planes = [cv2.resize(np.ascontiguousarray(image[..., c]), (size, size), interpolation=how) for c in range(image.shape[2])]
    return np.asarray(np.stack(planes, 2).reshape(size * size, -1), np.float32)
