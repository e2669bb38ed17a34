"""Photos as linear functions of base colour, and the base colours that explain them best under a given light.

Light, roughness and normals given, a pixel is linear in the base colour b of its texel, dielectric or metal:

    shade = b · slope + offset

Searches over the light (`light_intensity`) and over metal and dielectric (`metallic`) solve b for each candidate, which leaves only its own
unknowns (variable projection: Golub & Pereyra, *The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate*, 1973). Errors count as they are displayed: weights contain the squared slope of the sRGB curve. The solution is robust
(iteratively reweighted towards the sum of absolute errors), because normals that are slightly off move the reflection of the sun by
pixels: where it is predicted and not shown, the error is a hundred times that of all other pixels together. Pixels clipped at white
only bound b from below: they take part where b leaves them too dark.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gsbake.imaging.srgb import encode
from gsbake.kernels.declaration import kernel

Floats = NDArray[np.float64]

#: Linear values above this are taken as clipped.
CLIPPED = 0.95
#: Lowest linear colour at which the slope of the sRGB curve is taken.
MIN_SLOPE_COLOUR = 0.02
#: Rounds of the solution, and the error of an sRGB value (0..1) from which pixels weigh less in the robust one.
ROUNDS, ROBUST_SCALE = 3, 0.02


@dataclass(frozen=True)
class LinearShading:
    """Shading of a photo's pixels as a linear function of base colour: shade = b · `slope` + `offset`, both (n, 3)."""

    slope: NDArray[np.float32]
    offset: NDArray[np.float32]

    def srgb(self, base: NDArray[np.floating]) -> NDArray[np.float32]:
        """sRGB colours (n, 3), clipped at white, of base colours `base` (n, 3)."""
        return np.asarray(encode(np.clip(base * self.slope + self.offset, 0, 1)), np.float32)


@dataclass(frozen=True)
class LinearParts:
    """The shading of the same pixels as `dielectric` and as `metal`."""

    dielectric: LinearShading
    metal: LinearShading

    def of(self, metal: bool) -> LinearShading:
        """That of one kind."""
        return self.metal if metal else self.dielectric


#: Shades pixels of one photo at a roughness (texels,).
Shader = Callable[[NDArray[np.float32]], LinearParts]


@dataclass(frozen=True)
class PhotoSamples:
    """n pixels of one photo: the `texel` (n,) each shows, its linear `colour` (n, 3), `weight` (n,), the `block` (n,) of the photo it lies
    in, the function that shades them, and functions that shade them with normals `tilted` by `NORMAL_ERROR` along a tangent each."""

    texel: NDArray[np.int64]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    block: NDArray[np.int32]
    shade: Shader
    tilted: tuple[Shader, ...] = ()

    @cached_property
    def encoded(self) -> NDArray[np.float32]:
        """The colour (n, 3) in sRGB."""
        return encode(self.colour)


def perceptual_weights(samples: PhotoSamples) -> NDArray[np.float32]:
    """Weights (n, 3) of squared errors of linear colours: pixel weight times squared slope of the sRGB curve (a power of 1/2.4)."""
    return np.asarray(samples.weight[:, None] * np.maximum(samples.colour, MIN_SLOPE_COLOUR) ** (-7 / 6), np.float32)


def unclipped_weights(samples: PhotoSamples) -> NDArray[np.float32]:
    """`perceptual_weights`, 0 where the photo is clipped at white."""
    return perceptual_weights(samples) * (samples.colour < CLIPPED)


def observed_weight(photos: Sequence[PhotoSamples], texels: int) -> Floats:
    """Total weight (texels,) of the pixels that show each texel."""
    out = np.zeros(texels)
    for photo in photos:
        out += np.bincount(photo.texel, photo.weight, texels)
    return out


class BaseColourSolver:
    """Finds the base colours of `texels` texels in `photos` for any number of shadings."""

    def __init__(self, photos: Sequence[PhotoSamples], texels: int) -> None:
        self._texels, self._texel = texels, np.concatenate([samples.texel for samples in photos])
        self._colour = np.concatenate([samples.colour for samples in photos])
        self._weight = np.concatenate([*map(perceptual_weights, photos)])
        self._any_clipped = bool((self._colour >= CLIPPED).any())
        self._curve = np.maximum(self._colour, MIN_SLOPE_COLOUR) ** np.float32(-7 / 12)

    def solve(self, shadings: Sequence[LinearShading], lowest: float = 0.0, robust: bool = False) -> Floats:
        """Base colours (texels, 3) within [lowest, 1] that explain the photos under their `shadings` best; `lowest` where nothing tells.

        They have the least squared error; with `robust` about the least absolute one.
        """
        slope, offset = (np.concatenate([getattr(shading, part) for shading in shadings]) for part in ("slope", "offset"))
        base = np.full((self._texels, 3), lowest)
        rounds = ROUNDS if robust or self._any_clipped else 1
        solve_base_colours(self._texel, slope, offset, self._colour, self._weight, self._curve, lowest, rounds, robust, base)
        return base


@kernel(
    "i8[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f8, i8, b1, f8[:, ::1]",
    parallel=True,
    nogil=True,
    error_model="numpy",
)
def solve_base_colours(
    texel: Any, slope: Any, offset: Any, colour: Any, weight: Any, curve: Any, lowest: Any, rounds: Any, robust: Any, base: Any
) -> None:
    """Iteratively reweighted least squares for `base` (texels, 3), which starts at `lowest`, channel by channel.

    n pixels show `texel` (n,) as base · `slope` + `offset` where the photo has `colour`, with `weight` and, for the robust solution, errors
    scaled by the slope of the sRGB `curve`; (n, 3) each.
    """
    for k in prange(3):
        squares, products = np.zeros(len(base)), np.zeros(len(base))
        for turn in range(rounds):
            squares[:] = 0
            products[:] = 0
            for i in range(len(texel)):
                s, o, c, w, t = slope[i, k], offset[i, k], colour[i, k], weight[i, k], texel[i]
                if not o < CLIPPED:  # a reflection that is brighter than white by itself tells nothing of b
                    continue
                if turn:
                    shown = base[t, k] * s + o
                    if c >= CLIPPED and not shown < CLIPPED:
                        continue
                    if robust:
                        w /= max(abs(shown - c) * curve[i, k], ROBUST_SCALE)
                elif c >= CLIPPED:
                    continue
                squares[t] += w * s * s
                products[t] += w * s * (c - o)
            for t in range(len(base)):
                if squares[t] > 0:  # clipped pixels may all be explained by the last b
                    base[t, k] = min(max(products[t] / squares[t], lowest), 1.0)
