"""Ray-casting renderer of the finished asset with an alpha channel, after the rules of glTF 2.0.

Primary rays hit the triangles (Embree); at each hit the textures are sampled bilinearly: base colour as sRGB, decoded before filtering;
occlusion, roughness and metallic from R, G, B of one linear image; the normal map in the frame (tangent, w · n × t, normal) of the
interpolated vertex vectors. Samples are shaded one by one and averaged in linear radiance over each pixel (anti-aliasing). One mip level
per image (area filter) matches texel and sample footprints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.vectors import unit
from gsbake.imaging.sampling import bilinear
from gsbake.imaging.srgb import encode

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Asset:
    """A textured mesh in one frame (the glTF asset's when read from a GLB).

    `position`, `normal` (v, 3); `tangent` (v, 4) or None; `uv` (v, 2) with the origin top left; `faces` (f, 3). `base_color` (h, w, 3)
    linear, `orm` (h, w, 3) linear occlusion, roughness, metallic, `normal_map` (h, w, 3) vectors in -1..1, `emissive` (h, w, 3) linear
    radiance; the last three may be None.
    `unlit`: the base colour is the outgoing radiance. `wrap`: textures repeat beyond 0..1, else they are clamped to the edge.
    """

    position: NDArray[np.float64]
    normal: Floats
    tangent: Floats | None
    uv: Floats
    faces: NDArray[np.int32]
    base_color: Floats
    orm: Floats | None = None
    normal_map: Floats | None = None
    emissive: Floats | None = None
    unlit: bool = False
    wrap: bool = True

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre (3,) of the bounding box."""
        return np.asarray((self.position.min(0) + self.position.max(0)) / 2)

    @property
    def radius(self) -> float:
        """Distance of the farthest vertex from the centre."""
        return float(np.linalg.norm(self.position - self.centre, axis=1).max())


@dataclass(frozen=True, eq=False)
class Samples:
    """Surface samples of n camera rays in the asset's frame: `position`, unit `normal` and `view` (towards the camera) (n, 3), linear
    `base_color` (n, 3), `occlusion`, `roughness`, `metallic` (n,), emitted radiance `emissive` (n, 3) or None."""

    position: Floats
    normal: Floats
    view: Floats
    base_color: Floats
    occlusion: Floats
    roughness: Floats
    metallic: Floats
    emissive: Floats | None = None


class Shader(Protocol):
    """Maps samples to reflected linear radiance (n, 3)."""

    def __call__(self, samples: Samples) -> Floats:
        """Linear radiance towards the camera (n, 3)."""


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """A render: linear radiance with straight alpha `linear` (h, w, 3), `alpha` (h, w), and G-buffers averaged over the covered samples:
    `base_color` (h, w, 3) linear, unit `normal` (h, w, 3), `orm` (h, w, 3)."""

    linear: Floats
    alpha: Floats
    base_color: Floats
    normal: Floats
    orm: Floats

    @staticmethod
    def from_means(mean: Floats) -> RenderedImage:
        """From means over the samples of each pixel (h, w, 13): radiance, coverage, base colour, normal, ORM, all weighted by coverage."""
        straight: Floats = np.asarray(mean / np.maximum(mean[..., 3:4], 1e-6), np.float32)
        normal: Floats = straight[..., 7:10]
        normal = np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6), np.float32)
        return RenderedImage(straight[..., :3], mean[..., 3], straight[..., 4:7], normal, straight[..., 10:13])

    @property
    def rgb(self) -> Floats:
        """sRGB with straight alpha (h, w, 3) in 0..1."""
        return encode(self.linear)

    def over(self, grey: float) -> Floats:
        """The render (h, w, 3) over a uniform background, composited in sRGB values as photos with masks are."""
        return self.rgb * self.alpha[..., None] + np.float32(grey) * (1 - self.alpha[..., None])


def unlit(samples: Samples) -> Floats:
    """Shader of assets whose base colour is the outgoing radiance."""
    return samples.base_color


def uv_density(position: NDArray[Any], uv: NDArray[Any], faces: NDArray[Any]) -> float:
    """Texture area (UV units) per surface area of triangles (f, 3) with corners `position` (v, 3) and texture coordinates `uv` (v, 2)."""
    corner, uv = position[faces], uv[faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return float(np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).sum() / max(area.sum(), 1e-30))


def select_mip_level(camera: Camera, distance: NDArray[Any], density: float, shape: tuple[int, ...]) -> int:
    """Mip level of a texture (`shape` h, w, …) at which a texel is about as large as a sample's footprint on a surface at `distance` (n,)
    whose texture has the `density` of `uv_density`."""
    if len(distance) == 0:
        return 0
    footprint = float(np.median(distance)) ** 2 / (camera.fx * camera.fy)
    texels = density * shape[0] * shape[1] * footprint
    return max(0, min(round(0.5 * math.log2(max(texels, 1e-12))), int(math.log2(min(shape[:2])))))


def downsampled(image: Floats, level: int) -> Floats:
    """An image (h, w, c) reduced by 2**level with an area filter."""
    if level == 0:
        return image
    size = (max(1, image.shape[1] >> level), max(1, image.shape[0] >> level))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def tangent_space_normal(normal: Floats, tangent: Floats, local: Floats) -> Floats:
    """Unit normals (n, 3) of vectors `local` (n, 3) of a normal map, at `normal` (n, 3) with `tangent` (n, 4), w the handedness (glTF)."""
    sign = np.where(tangent[:, 3:] < 0, np.float32(-1), np.float32(1))
    bitangent = sign * np.cross(normal, tangent[:, :3])
    return unit(local[:, :1] * tangent[:, :3] + local[:, 1:2] * bitangent + local[:, 2:3] * normal)


class Renderer:
    """Renders one asset from many cameras; the ray tracing structure and the mip levels are cached."""

    def __init__(self, asset: Asset, threads: int | None = None) -> None:
        self.asset = asset
        self.caster = RayCaster(asset.position, asset.faces, threads)
        self._density = uv_density(asset.position, asset.uv, asset.faces)
        self._texture = lru_cache(maxsize=16)(self._mip_level)

    def _mip_level(self, name: str, level: int) -> Floats | None:
        """Texture `name` downsampled by 2**level, or None when the asset has no such texture."""
        image: Floats | None = getattr(self.asset, name)
        return None if image is None else downsampled(image, level)

    def _sample_texture(self, name: str, level: int, uv: Floats) -> Floats | None:
        """Texture values (n, 3) at uv (n, 2), or None when the asset has no such texture."""
        image = self._texture(name, level)
        if image is None:
            return None
        return bilinear(image, uv, self.asset.wrap)

    def draw(self, camera: Camera, shader: Shader, samples: int = 2) -> RenderedImage:
        """Render from `camera` (frame of the asset) with samples² rays per pixel."""
        height, width = camera.height, camera.width
        fine = camera.scaled(width * samples, height * samples)
        inside = self._screen_bounds(fine)
        rays = fine.rays()[inside]
        shape = rays.shape[:2]
        hits = self.caster.first_hit(fine.centre[None], rays.reshape(-1, 3))
        index = np.flatnonzero(hits.hit)
        surface = self._samples(fine, rays.reshape(-1, 3)[index], hits.face[index], hits.bary[index], hits.distance[index])
        radiance = shader(surface) if surface.emissive is None else shader(surface) + surface.emissive
        columns = (
            radiance, np.ones((len(index), 1)), surface.base_color, surface.normal,
            np.stack([surface.occlusion, surface.roughness, surface.metallic], 1),
        )  # fmt: skip
        part = np.zeros((shape[0] * shape[1], 13), np.float32)
        part[index] = np.concatenate(columns, 1)
        full = np.zeros((fine.height, fine.width, 13), np.float32)
        full[inside] = part.reshape(*shape, 13)
        mean = full.reshape(height, samples, width, samples, 13).mean((1, 3), dtype=np.float32)
        return RenderedImage.from_means(mean)

    def _screen_bounds(self, camera: Camera) -> tuple[slice, slice]:
        """Rows and columns of the asset's projection; the whole image when a vertex is behind the camera."""
        pixels, depth = camera.project(self.asset.position)
        if depth.min() <= 0:
            return slice(0, camera.height), slice(0, camera.width)
        low = np.clip(np.floor(pixels.min(0)).astype(int) - 1, 0, [camera.width, camera.height])
        high = np.clip(np.ceil(pixels.max(0)).astype(int) + 1, low, [camera.width, camera.height])
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _samples(self, camera: Camera, rays: NDArray[np.float64], face: NDArray[np.int32], bary: Floats, distance: Floats) -> Samples:
        asset = self.asset
        corners = asset.faces[face]

        def interpolate(values: Floats) -> Floats:
            return np.einsum("nk,nkc->nc", bary, values[corners]).astype(np.float32)

        uv, normal = interpolate(asset.uv), unit(interpolate(asset.normal))
        view = unit(-rays.astype(np.float32))

        def texture(name: str) -> Floats | None:
            image: Floats | None = getattr(asset, name)
            if image is None:
                return None
            return self._sample_texture(name, select_mip_level(camera, distance, self._density, image.shape), uv)

        base, orm, local = texture("base_color"), texture("orm"), texture("normal_map")
        if local is not None and asset.tangent is not None:
            normal = tangent_space_normal(normal, interpolate(asset.tangent), local)
        if orm is None:
            orm = np.broadcast_to(np.array([1, 1, 0], np.float32), (len(face), 3))
        assert base is not None
        position, emissive = interpolate(asset.position.astype(np.float32)), texture("emissive")
        return Samples(position, normal, view, base, orm[:, 0], orm[:, 1], orm[:, 2], emissive)
