"""Photos as linear functions of base colour, and the base colours that explain them best under a given light.

Light, roughness and normals given, a pixel is linear in the base colour b of its texel, dielectric or metal:

    shade = b · slope + offset

Searches over the light (`light_intensity`) and over metal and dielectric (`metallic`) solve b for each candidate, which leaves only its own
unknowns (variable projection: Golub & Pereyra, *The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate*, 1973). Errors count as they are displayed: weights contain the squared slope of the sRGB curve. The solution is robust
(iteratively reweighted towards the sum of absolute errors), because normals that are slightly off move the reflection of the sun by
pixels: where it is predicted and not shown, the error is a hundred times that of all other pixels together. Pixels clipped at white
only bound b from below: they take part where b leaves them too dark.

The same photos are shaded with gradients for the steps of the fit (`ShadingStep`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode, encode
from gsbake.kernels.declaration import kernel
from gsbake.materials import fit_kernel
from gsbake.materials.photo import Photo, interpolate, joined
from gsbake.shading import brdf
from gsbake.shading.light_motion import rotated
from gsbake.shading.light_tables import LightTables, prefilter_cube_map

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

#: Linear values above this are taken as clipped.
CLIPPED = 0.95
#: Lowest linear colour at which the slope of the sRGB curve is taken.
MIN_SLOPE_COLOUR = 0.02
#: Rounds of the solution, and the error of an sRGB value (0..1) from which pixels weigh less in the robust one.
ROUNDS, ROBUST_SCALE = 3, 0.02
#: Standard deviation of normals, as a length added to the unit normal along each tangent.
NORMAL_ERROR = 0.035
#: Turn of the tilt of normals from pixel to pixel.
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


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
    """n pixels of photos under one light: the `texel` (n,) each shows, its linear `colour` (n, 3), `weight` (n,), the `block` (n,) of a
    photo it lies in, the function that shades them, and those that shade them with normals `tilted` by their error; `start` of each photo
    but the first among the pixels."""

    texel: NDArray[np.int64]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    block: NDArray[np.int32]
    shade: Shader
    tilted: tuple[Shader, ...] = ()
    start: tuple[int, ...] = ()

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


def observed_weight(photos: Sequence[PhotoSamples], texels: int) -> Doubles:
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

    def solve(self, shadings: Sequence[LinearShading], lowest: float = 0.0, robust: bool = False) -> Doubles:
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


#: An array (n,) of `fit_kernel.TRANSPORT` or `fit_kernel.LOCAL`.
Records = NDArray[np.void]


@dataclass(frozen=True)
class KernelTables:
    """A prefiltered light as the kernels read it: the flat `table` (rows, 3) and its layout, and the split-sum table `lut`."""

    table: Floats
    knots: Floats
    sizes: NDArray[np.int64]
    offsets: NDArray[np.int64]
    lut: Floats

    @classmethod
    def of(cls, tables: LightTables) -> KernelTables:
        """The arrays of `tables`, without gradient."""
        layout = tables.layout
        table = np.ascontiguousarray(tables.table.detach().numpy())
        return cls(table, np.array(layout.roughness, np.float32), np.array(layout.sizes), np.array(layout.offsets), brdf.split_sum_table())

    @property
    def arrays(self) -> tuple[Floats, Floats, NDArray[np.int64], NDArray[np.int64], Floats]:
        """All arrays, in the order of the kernels' arguments."""
        return self.table, self.knots, self.sizes, self.offsets, self.lut


@dataclass(frozen=True)
class PhotoLights:
    """The prefiltered light `radiance` (6, s, s, 3) as each photo sees it, without gradient; computed once per rotation."""

    radiance: torch.Tensor
    _known: dict[bytes, KernelTables] = field(default_factory=dict)

    @torch.no_grad()
    def tables(self, to_light: NDArray[np.float64] | None) -> KernelTables:
        """The tables in the object's frame of a photo with the rotation `to_light` (3, 3); None: the light stands."""
        key = b"" if to_light is None else to_light.tobytes()
        if key not in self._known:
            self._known[key] = KernelTables.of(prefilter_cube_map(rotated(self.radiance, to_light)))
        return self._known[key]

    def times(self, factor: float) -> PhotoLights:
        """The light times a `factor`, with the tables known so far."""
        known = {key: replace(tables, table=tables.table * np.float32(factor)) for key, tables in self._known.items()}
        return PhotoLights(self.radiance * factor, known)


class ShadingStep:
    """Buffers for shading photos of `texels` texels and for the gradients."""

    def __init__(self, texels: int) -> None:
        self.gradient = np.zeros((texels, fit_kernel.PARAMETERS), np.float32)
        self._pixels = np.zeros((0, fit_kernel.SHADING), np.float32)
        self.table = np.zeros((fit_kernel.CHUNKS, 0, 3), np.float32)

    def __call__(
        self, photo: Photo, values: Floats, tables: KernelTables, transport: Records, residual_weight: float, robust: float, factor: float
    ) -> NDArray[np.float64]:
        """Shade the photo, leave the texels' gradient in `gradient` and the table's in `table` (CHUNKS, rows, 3); the sums (3,) of loss,
        squared error and weight. Gradients are multiplied by `factor`; with 0 they are left out."""
        n = len(photo)
        if len(self._pixels) < n:
            self._pixels = np.zeros((n, fit_kernel.SHADING), np.float32)
        if self.table.shape[1] != len(tables.table):
            self.table = np.zeros((fit_kernel.CHUNKS, len(tables.table), 3), np.float32)
        self.table[:] = 0
        sums = np.zeros((fit_kernel.CHUNKS, 3))
        fit_kernel.shade_and_differentiate(
            photo.texel, photo.bilinear, photo.normal, photo.view, photo.colour, photo.weight, photo.reflected, values, transport,
            *tables.arrays, np.float32(residual_weight), np.float32(robust), np.float32(factor), self._pixels, self.table, sums,
        )  # fmt: skip
        if factor:
            fit_kernel.gather_gradient(*photo.entries, self._pixels, values, self.gradient)
        return np.asarray(sums.sum(0))


@dataclass(frozen=True)
class PhotoShader:
    """Shades the pixels of a `photo` with the `normal` (n, 3) under the light of `tables`, given their light transport `local` (n,) and
    that of the texels that they reflect; each pixel counts for its dominant texel."""

    photo: Photo
    normal: Floats
    tables: KernelTables
    local: Records
    transport: Records

    @cached_property
    def _incident(self) -> tuple[Floats, Floats]:
        """The light (n, 3) that does not depend on roughness: diffuse, and what the texel sends that the reflected ray meets."""
        out = np.empty_like(self.normal), np.empty_like(self.normal)
        photo = self.photo
        fit_kernel.incident_light(self.normal, photo.view, photo.reflected, self.local, self.transport, *self.tables.arrays, *out)
        return out

    def __call__(self, roughness: Floats) -> LinearParts:
        """The shading of both kinds at `roughness` (texels,)."""
        diffuse, specular, scaled, edge = (np.empty_like(self.normal) for _ in range(4))
        fit_kernel.linear_shading(
            self.photo.dominant_texel, self.normal, self.photo.view, self.photo.reflected, self.local, *self._incident,
            np.ascontiguousarray(roughness, np.float32), *self.tables.arrays, diffuse, specular, scaled, edge,
        )  # fmt: skip
        emission = self.local["emission"]
        return LinearParts(LinearShading(diffuse, specular + emission), LinearShading(scaled, edge + emission))


def linear_samples(
    photos: Iterable[Photo], normal_offset: Floats, transport: Records, lights: PhotoLights, tilted: bool = False
) -> list[PhotoSamples]:
    """The pixels of `photos` for searches over all photos, those under the same light together, with `tilted` normals as well, on texels
    with `normal_offset` (texels, 3) and light `transport` (texels,)."""
    block = np.ascontiguousarray(transport.view(np.float32).reshape(len(transport), -1)[:, : fit_kernel.LOCAL.itemsize // 4])
    samples, lit = [], dict[bytes, list[Photo]]()
    for photo in photos:
        lit.setdefault(b"" if photo.to_light is None else photo.to_light.tobytes(), []).append(photo)
    for together in lit.values():
        photo, start = joined(together), tuple(np.cumsum([*map(len, together)])[:-1].tolist())
        normal = photo.normal + interpolate(normal_offset, photo.texel, photo.bilinear)
        local = interpolate(block, photo.texel, photo.bilinear).view(fit_kernel.LOCAL)[:, 0]
        shader, *others = (
            PhotoShader(photo, n, lights.tables(photo.to_light), local, transport) for n in (normal, *([_tilted(normal)] if tilted else []))
        )
        samples.append(PhotoSamples(photo.dominant_texel, decode(photo.colour), photo.weight, photo.block, shader, tuple(others), start))
    return samples


def _tilted(normal: Floats) -> Floats:
    """The `normal` (n, 3), of any length, tilted by `NORMAL_ERROR` along both tangents together.

    These turn by the golden angle from pixel to pixel, so that over the pixels of a texel squared changes are those of two tilts each.
    """
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    axis = np.where(np.abs(unit[:, :1]) < 0.7, np.array([[1, 0, 0]]), np.array([[0, 1, 0]])).astype(np.float32)
    first = np.cross(unit, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-20)
    angle = (GOLDEN_ANGLE * np.arange(len(unit)))[:, None]
    tilt = np.cos(angle) * first + np.sin(angle) * np.cross(unit, first)
    return np.asarray(unit + math.sqrt(2) * NORMAL_ERROR * tilt, np.float32)
