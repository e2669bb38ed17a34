"""Ray-casting renderer of any glTF scene: several meshes and materials, alpha masks and blending, texture transforms.

As `report.render`, which draws one opaque asset; here every ray goes on through transparent surfaces, at most `MAX_LAYERS` of them,
composited front to back (Porter & Duff, *Compositing digital images*, SIGGRAPH 1984). Materials beyond metallic-roughness are left out.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.vectors import unit
from gsbake.gltf.scene import Scene, TextureUse
from gsbake.imaging.encoded import image_size
from gsbake.imaging.image_process import read_image
from gsbake.imaging.sampling import bilinear
from gsbake.imaging.srgb import decode_bytes
from gsbake.report.render import (
    Floats,
    RenderedImage,
    Samples,
    Shader,
    downsampled,
    select_mip_level,
    tangent_space_normal,
    uv_density,
)

#: Surfaces that one ray passes.
MAX_LAYERS = 8
#: Transmittance below which a ray ends.
OPAQUE = 1e-3
CLAMP, MIRROR = 33071, 33648
#: Bytes per pixel and use of an image: values in single precision, its mip levels, and a copy while they are made.
TEXTURE_BYTES = 48


class SceneRenderer:
    """Renders a scene from many cameras; the ray tracing structure and the images' mip levels are cached."""

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        self.scene = scene
        self._count_textures()
        vertices, faces = scene.vertices, scene.faces
        self._caster = RayCaster(vertices, faces, threads)
        self._vertices = vertices
        self._part = np.repeat(np.arange(len(scene.parts)), [len(p.faces) for p in scene.parts])
        self._first = np.cumsum([0, *(len(p.faces) for p in scene.parts)])
        self._image = lru_cache(maxsize=None)(self._pixels)
        self._texture = lru_cache(maxsize=256)(self._mip_level)
        self._density = lru_cache(maxsize=None)(self._uv_density)
        low, high = vertices.min(0), vertices.max(0)
        self.centre: NDArray[np.float64] = (low + high) / 2
        self.radius = max(float(np.linalg.norm(vertices - self.centre, axis=1).max()), 1e-30)

    def _count_textures(self) -> None:
        """Spend the memory of all textures in use, from their headers. Raises BadInputError."""
        document = self.scene.document
        used = {(use.image, role) for part in self.scene.parts for role, use in self.scene.materials[part.material].textures.items()}
        with document.readable():
            for image in {image for image, _ in used}:
                size = image_size(document.image(image), f"image {image} of '{document.name}'")
                document.spend(size.width * size.height * TEXTURE_BYTES * sum(found == image for found, _ in used))

    def draw(self, camera: Camera, shader: Shader, samples: int = 2) -> RenderedImage:
        """Render from `camera` (the scene's frame) with samples² rays per pixel."""
        height, width = camera.height, camera.width
        fine = camera.scaled(width * samples, height * samples)
        rays = fine.rays().reshape(-1, 3)
        origin = np.broadcast_to(fine.centre, rays.shape).copy()
        depth = np.zeros(len(rays))
        left = np.ones(len(rays), np.float32)
        total = np.zeros((len(rays), 13), np.float32)
        active = np.arange(len(rays))
        for _ in range(MAX_LAYERS):
            hits = self._caster.first_hit(origin[active], rays[active])
            where = np.flatnonzero(hits.hit)
            if not len(where):
                break
            active = active[where]
            distance = hits.distance[where].astype(np.float64)
            depth[active] += distance
            values, alpha = self._shade(fine, rays[active], depth[active], hits.face[where], hits.bary[where], shader)
            weight = (left[active] * alpha)[:, None]
            total[active] += weight * np.concatenate([values[:, :3], np.ones((len(active), 1), np.float32), values[:, 3:]], 1)
            left[active] *= 1 - alpha
            active = active[left[active] > OPAQUE]
            if not len(active):
                break
            step = depth[active] + 1e-5 * self.radius / np.linalg.norm(rays[active], axis=1)
            depth[active] = step
            origin[active] = fine.centre + step[:, None] * rays[active]
        mean = total.reshape(height, samples, width, samples, 13).mean((1, 3), dtype=np.float32)
        return RenderedImage.from_means(mean)

    def _shade(
        self, camera: Camera, rays: NDArray[np.float64], depth: NDArray[np.float64], face: NDArray[np.int32], bary: Floats, shader: Shader
    ) -> tuple[Floats, Floats]:
        """Radiance, base colour, normal and ORM (n, 12) of hits, and their alpha (n,)."""
        out, alpha = np.zeros((len(face), 12), np.float32), np.ones(len(face), np.float32)
        part_of = self._part[face]
        for index in np.unique(part_of):
            here = np.flatnonzero(part_of == index)
            part = self.scene.parts[index]
            material = self.scene.materials[part.material]
            surface, coverage = self._surface(camera, index, rays[here], depth[here], face[here] - self._first[index], bary[here])
            radiance = surface.base_color if material.unlit else shader(surface)
            if surface.emissive is not None:
                radiance = radiance + surface.emissive
            packed = np.stack([surface.occlusion, surface.roughness, surface.metallic], 1)
            out[here] = np.concatenate([radiance, surface.base_color, surface.normal, packed], 1)
            alpha[here] = coverage
        return out, alpha

    def _surface(
        self, camera: Camera, index: int, rays: NDArray[np.float64], depth: NDArray[np.float64], face: NDArray[Any], bary: Floats
    ) -> tuple[Samples, Floats]:
        part = self.scene.parts[index]
        material = self.scene.materials[part.material]
        corners = part.faces[face]

        def interpolate(values: NDArray[Any]) -> Floats:
            return np.einsum("nk,nkc->nc", bary, values[corners]).astype(np.float32)

        def texture(role: str) -> Floats | None:
            use = material.textures.get(role)
            if use is None or use.uv not in part.uv:
                return None
            shape = self._image(use.image, role).shape
            level = select_mip_level(camera, depth, self._density(index, use.uv, role), shape)
            return _sample(self._texture(use.image, role, level), use, interpolate(part.uv[use.uv]))

        view = unit(-rays).astype(np.float32)
        normal = unit(interpolate(part.normal)).astype(np.float32)
        local = texture("normal")
        if local is not None and part.tangent is not None:
            scale = np.array([material.normal_scale, material.normal_scale, 1], np.float32)
            normal = tangent_space_normal(normal, interpolate(part.tangent), scale * local[:, :3])
        corner = part.position[corners]
        geometric = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        behind = np.einsum("nd,nd->n", geometric, rays) > 0
        normal = np.where(behind[:, None], -normal, normal).astype(np.float32)

        colour = np.tile(np.array(material.base_color, np.float32), (len(face), 1))
        base = texture("base_color")
        if base is not None:
            colour = colour * base
        if part.colour is not None:
            colour = colour * interpolate(part.colour)
        packed, occlusion, emissive = texture("orm"), texture("occlusion"), texture("emissive")
        roughness = np.full(len(face), material.roughness, np.float32) * (1 if packed is None else packed[:, 1])
        metallic = np.full(len(face), material.metallic, np.float32) * (1 if packed is None else packed[:, 2])
        ambient = np.ones(len(face), np.float32)
        if occlusion is not None:
            ambient = 1 + np.float32(material.occlusion_strength) * (occlusion[:, 0] - 1)
        glow: Floats | None = None
        if any(material.emissive):
            glow = np.tile(np.array(material.emissive, np.float32), (len(face), 1)) * (1 if emissive is None else emissive[:, :3])
        match material.alpha_mode:
            case "MASK":
                alpha = (colour[:, 3] >= material.alpha_cutoff).astype(np.float32)
            case "BLEND":
                alpha = np.clip(colour[:, 3], 0, 1)
            case _:
                alpha = np.ones(len(face), np.float32)
        if not material.double_sided:  # glTF leaves out the back of single-sided surfaces
            alpha = np.where(behind, np.float32(0), alpha)
        position = interpolate(part.position.astype(np.float32))
        rough, metal = (np.clip(v, 0, 1).astype(np.float32) for v in (roughness, metallic))
        surface = Samples(position, normal, view, np.ascontiguousarray(colour[:, :3]), ambient.astype(np.float32), rough, metal, glow)
        return surface, alpha

    def _pixels(self, image: int, role: str) -> Floats:
        """An image as values: linear colours with alpha, vectors in -1..1, or channels in 0..1."""
        document = self.scene.document
        with document.readable():
            content = document.image(image)
        pixels = read_image(content, f"image {image} of '{document.name}'")
        if role in ("base_color", "emissive"):
            alpha = pixels[..., 3:].astype(np.float32) / np.float32(255)
            return np.concatenate([decode_bytes(pixels[..., :3]), alpha], -1)
        values = pixels[..., :3].astype(np.float32)
        return np.asarray(values / np.float32(127.5) - 1 if role == "normal" else values / np.float32(255), np.float32)

    def _mip_level(self, image: int, role: str, level: int) -> Floats:
        """An image downsampled by 2**level."""
        return downsampled(self._image(image, role), level)

    def _uv_density(self, index: int, uv_set: int, role: str) -> float:
        """Texture area (UV units) per surface area of a part."""
        part = self.scene.parts[index]
        use = self.scene.materials[part.material].textures[role]
        return uv_density(part.position, use.coordinates(part.uv[uv_set]), part.faces)


def _sample(pixels: Floats, use: TextureUse, uv: Floats) -> Floats:
    """Bilinear values (n, c) at texture coordinates (n, 2) before the texture's transform."""
    coordinates = use.coordinates(uv)
    for axis, mode in enumerate(use.wrap):
        half = np.float32(0.5 / pixels.shape[1 - axis])
        if mode == MIRROR:
            folded = np.mod(coordinates[:, axis], 2)
            coordinates[:, axis] = np.clip(np.where(folded > 1, 2 - folded, folded), half, 1 - half)
        elif mode == CLAMP:
            coordinates[:, axis] = np.clip(coordinates[:, axis], half, 1 - half)
    return bilinear(pixels, coordinates, wrap=True)
