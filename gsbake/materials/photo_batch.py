"""The pixels of one photo, laid out for the kernels of the material fit, and their shading as a linear function of base colour."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode
from gsbake.materials import fit_kernel
from gsbake.materials.linear_shading import LinearShading, PhotoSamples, Shader
from gsbake.materials.metallic import NORMAL_ERROR
from gsbake.materials.pixels import Pixels
from gsbake.shading import brdf
from gsbake.shading.light_motion import rotated
from gsbake.shading.light_tables import LightTables, prefilter_cube_map

Floats = NDArray[np.float32]

#: Columns of a texel's light transport: visibility (0..1) of the present light and, for specular reflection, of uniform light (ambient
#: occlusion); indirect irradiance / π; emission; for reflections of the object diffuse radiosity / π, base colour times metallic,
#: roughness, unit normal, and metallic.
VISIBILITY, OCCLUSION, INDIRECT, EMISSION = 0, 1, slice(2, 5), slice(5, 8)
DIFFUSE, METAL_COLOUR, ROUGHNESS, NORMAL, METALLIC = slice(8, 11), slice(11, 14), 14, slice(15, 18), 18
#: The columns that pixels interpolate.
LOCAL = slice(0, 8)


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
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """All arrays, in the order of the kernels' arguments."""
        return self.table, self.knots, self.sizes, self.offsets, self.lut


@dataclass
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


@dataclass(frozen=True)
class TexelInputs:
    """What searches read of the texels, each in one block of memory: normal offsets (n, 3), the light transport (n, 8) at a pixel, and all
    of it (n, TRANSPORT), which reflections show."""

    normal_offset: Floats
    local: Floats
    transport: Floats

    @classmethod
    def of(cls, values: Floats, transport: Floats) -> TexelInputs:
        """Of texel `values` (n, PARAMETERS) and their `transport` (n, TRANSPORT)."""
        return cls(*(np.ascontiguousarray(x) for x in (values[:, 5:], transport[:, LOCAL], transport)))


@dataclass(frozen=True)
class PhotoBatch:
    """The n pixels of one photo, fields as in `Pixels`, with the mesh's `normal` (n, 3) there, of any length; `reflected` is empty where
    reflections were not traced."""

    texel: NDArray[np.int32]
    bilinear: Floats
    view: Floats
    colour: Floats
    weight: Floats
    block: NDArray[np.int32]
    normal: Floats
    reflected: NDArray[np.int32]
    to_light: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, pixels: Pixels, normal: Floats) -> PhotoBatch:
        """The `pixels` of a photo on a mesh whose texels have the `normal` (texels, 3)."""
        reflected = np.zeros(0, np.int64) if pixels.reflected_texel is None else pixels.reflected_texel
        texel = np.ascontiguousarray(pixels.texel, np.int32)
        bilinear, view, colour = (np.ascontiguousarray(x, np.float32) for x in (pixels.bilinear, pixels.view, pixels.colour))
        weight = np.ascontiguousarray(pixels.weight, np.float32)
        normals = interpolate(normal, texel, bilinear)
        return cls(texel, bilinear, view, colour, weight, pixels.block, normals, reflected.astype(np.int32), pixels.to_light)

    def __len__(self) -> int:
        return len(self.weight)

    @cached_property
    def dominant_texel(self) -> NDArray[np.int64]:
        """The texel (n,) with the largest bilinear weight in each pixel."""
        return np.take_along_axis(self.texel, self.bilinear.argmax(1)[:, None], 1)[:, 0].astype(np.int64)

    @cached_property
    def entries(self) -> tuple[NDArray[Any], ...]:
        """The pixels of each texel: the texels `touched` (m,) in order, `start` (m + 1,) of their entries, `pixel` and `share` of each."""
        flat, share = self.texel.ravel(), self.bilinear.ravel()
        used = np.flatnonzero(share > 0)
        order = used[np.argsort(flat[used], kind="stable")]
        touched, start = np.unique(flat[order], return_index=True)
        return touched, np.append(start, len(order)), (order // 4).astype(np.int32), share[order]

    def select(self, chosen: NDArray[np.bool_]) -> PhotoBatch:
        """The pixels whose dominant texel is `chosen` (texels,)."""
        return self._rows(chosen[self.dominant_texel])

    def every(self, step: int) -> PhotoBatch:
        """Every `step`-th pixel."""
        return self if step == 1 else self._rows(slice(None, None, step))

    def _rows(self, keep: Any) -> PhotoBatch:
        return PhotoBatch(
            self.texel[keep], self.bilinear[keep], self.view[keep], self.colour[keep], self.weight[keep], self.block[keep],
            self.normal[keep], self.reflected[keep] if len(self.reflected) else self.reflected, self.to_light,
        )  # fmt: skip

    def samples(self, texels: TexelInputs, tables: KernelTables, tilted: bool = False) -> PhotoSamples:
        """The pixels for searches over all photos, with `tilted` normals as well; each counts for its dominant texel."""
        normal = self.normal + interpolate(texels.normal_offset, self.texel, self.bilinear)
        light = tables, interpolate(texels.local, self.texel, self.bilinear), texels.transport
        others = tuple(self._shader(n, *light) for n in _tilted(normal)) if tilted else ()
        return PhotoSamples(self.dominant_texel, decode(self.colour), self.weight, self.block, self._shader(normal, *light), others)

    def _shader(self, normal: Floats, tables: KernelTables, local: Floats, transport: Floats) -> Shader:
        """The function that shades the pixels with the `normal` (n, 3), their light transport `local` (n, 8), and that of the texels."""
        emission = local[:, EMISSION]
        view, reflected = np.ascontiguousarray(self.view), np.ascontiguousarray(self.reflected)  # the kernels' layout
        light: list[tuple[Floats, Floats]] = []
        last: list[tuple[NDArray[np.float32], tuple[Floats, ...]]] = []

        def parts(roughness: NDArray[np.float32]) -> tuple[Floats, ...]:
            if not light:
                light.append((np.empty_like(normal), np.empty_like(normal)))
                fit_kernel.incident_light(normal, view, reflected, local, transport, *tables.arrays, *light[0])
            if not last or last[0][0] is not roughness:
                out = tuple(np.empty_like(normal) for _ in range(4))
                fit_kernel.linear_shading(
                    self.dominant_texel, normal, view, reflected, local, *light[0], np.ascontiguousarray(roughness, np.float32),
                    *tables.arrays, *out,
                )  # fmt: skip
                last[:] = [(roughness, out)]
            return last[0][1]

        def shaded(roughness: NDArray[np.float32], metallic: float) -> LinearShading:
            diffuse, specular, scaled, edge = parts(roughness)
            return LinearShading(scaled, edge + emission) if metallic else LinearShading(diffuse, specular + emission)

        return shaded


def _tilted(normal: Floats) -> tuple[Floats, Floats]:
    """The `normal` (n, 3), of any length, tilted by `NORMAL_ERROR` along two tangents."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    axis = np.where(np.abs(unit[:, :1]) < 0.7, np.array([[1, 0, 0]]), np.array([[0, 1, 0]])).astype(np.float32)
    first = np.cross(unit, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-20)
    step = np.float32(NORMAL_ERROR)
    return unit + step * first, unit + step * np.cross(unit, first)


def texel_weight(batches: Iterable[PhotoBatch], count: int) -> Floats:
    """Total weight (count,) of the pixels that show each texel."""
    weight = np.zeros(count)
    for batch in batches:
        touched, start, pixel, share = batch.entries
        weight[touched] += np.add.reduceat(share * batch.weight[pixel], start[:-1])
    return weight.astype(np.float32)


def interpolate(values: NDArray[Any], texel: NDArray[Any], bilinear: Floats) -> Floats:
    """`values` (texels, c) at pixels with the taps `texel` (n, 4) and weights `bilinear` (n, 4): (n, c)."""
    out = np.empty((len(texel), values.shape[1]), np.float32)
    taps = np.ascontiguousarray(texel), np.ascontiguousarray(bilinear)
    fit_kernel.interpolate_taps(np.ascontiguousarray(values, np.float32), *taps, out)
    return out


class FitStep:
    """Buffers for shading photos of `texels` texels and for the gradients."""

    def __init__(self, texels: int) -> None:
        self.gradient = np.zeros((texels, fit_kernel.PARAMETERS), np.float32)
        self._pixels = np.zeros((0, fit_kernel.SHADING), np.float32)
        self.table = np.zeros((fit_kernel.CHUNKS, 0, 3), np.float32)

    def __call__(
        self,
        batch: PhotoBatch,
        values: Floats,
        tables: KernelTables,
        transport: Floats,
        residual_weight: float,
        robust: float,
        factor: float,
    ) -> NDArray[np.float64]:
        """Shade the photo, leave the texels' gradient in `gradient` and the table's in `table` (CHUNKS, rows, 3); the sums (3,) of loss,
        squared error and weight. Gradients are multiplied by `factor`; with 0 they are left out."""
        n = len(batch)
        if len(self._pixels) < n:
            self._pixels = np.zeros((n, fit_kernel.SHADING), np.float32)
        if self.table.shape[1] != len(tables.table):
            self.table = np.zeros((fit_kernel.CHUNKS, len(tables.table), 3), np.float32)
        self.table[:] = 0
        sums = np.zeros((fit_kernel.CHUNKS, 3))
        fit_kernel.shade_and_differentiate(
            batch.texel, batch.bilinear, batch.normal, batch.view, batch.colour, batch.weight, batch.reflected, values, transport,
            *tables.arrays, np.float32(residual_weight), np.float32(robust), np.float32(factor), self._pixels, self.table, sums,
        )  # fmt: skip
        if factor:
            fit_kernel.gather_gradient(*batch.entries, self._pixels, values, self.gradient)
        return np.asarray(sums.sum(0))
