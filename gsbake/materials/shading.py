"""Photos shaded by the kernels: with gradients for steps of the fit, and as linear functions of base colour for searches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.srgb import decode
from gsbake.materials import fit_kernel
from gsbake.materials.linear_shading import LinearParts, LinearShading, PhotoSamples
from gsbake.materials.metallic import NORMAL_ERROR
from gsbake.materials.photo import Photo, interpolate
from gsbake.shading import brdf
from gsbake.shading.light_motion import rotated
from gsbake.shading.light_tables import LightTables, prefilter_cube_map

Floats = NDArray[np.float32]
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
    """The pixels of `photos` for searches over all photos, with `tilted` normals as well, on texels with `normal_offset` (texels, 3) and
    light `transport` (texels,)."""
    block = np.ascontiguousarray(transport.view(np.float32).reshape(len(transport), -1)[:, : fit_kernel.LOCAL.itemsize // 4])
    samples = []
    for photo in photos:
        normal = photo.normal + interpolate(normal_offset, photo.texel, photo.bilinear)
        local = interpolate(block, photo.texel, photo.bilinear).view(fit_kernel.LOCAL)[:, 0]
        shader, *others = (
            PhotoShader(photo, n, lights.tables(photo.to_light), local, transport) for n in (normal, *(_tilted(normal) if tilted else ()))
        )
        samples.append(PhotoSamples(photo.dominant_texel, decode(photo.colour), photo.weight, photo.block, shader, tuple(others)))
    return samples


def _tilted(normal: Floats) -> tuple[Floats, Floats]:
    """The `normal` (n, 3), of any length, tilted by `NORMAL_ERROR` along two tangents."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    axis = np.where(np.abs(unit[:, :1]) < 0.7, np.array([[1, 0, 0]]), np.array([[0, 1, 0]])).astype(np.float32)
    first = np.cross(unit, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-20)
    step = np.float32(NORMAL_ERROR)
    return unit + step * first, unit + step * np.cross(unit, first)
