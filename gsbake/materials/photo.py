"""Photos as bilinear reads of a texture: texels, view direction, colour and weight of each pixel.

A ray through each pixel's centre meets the mesh once; from then on a photo is a list of texture reads, and the fit needs no rasteriser.
Where a texture is finer than the photos, a pixel is an average of several texels, found by supersampling (`subpixel_texels`). Pixels near
a mask's boundary, near depth edges and at grazing views weigh less: there a small error of shape shows another part of the surface.

View dependence is measured on the final mesh: the brightness of surface points over the photos that show them. Stereo's points exist only
where photos match; these are anywhere on the object, so specular areas count too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import View
from gsbake.capture.view_dependence import BrightnessStatistics, SurfaceBrightness
from gsbake.geometry.cameras import Array, Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode, encode
from gsbake.materials.fit_kernel import interpolate_taps
from gsbake.shading.reflections import trace_reflections
from gsbake.texturing.projection import BOUND_WEIGHT, BRIGHTER, edge_weights
from gsbake.texturing.resampling import CoarseTexture
from gsbake.texturing.texels import Texels
from gsbake.texturing.view_fusion import CLIPPED

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class PixelWeights:
    """Which pixels of a photo are read, and what they weigh: 0 at the first value of each pair, 1 from the second on."""

    #: Cosine between view and face normal: at grazing views a small error of shape shows another place.
    cosine: tuple[float, float] = (0.15, 0.4)
    #: Distance to the mask's boundary in pixels: masks are some pixels off, and lenses blur.
    mask_margin: tuple[float, float] = (1.5, 4.0)
    #: A depth step larger than this share of the object's diagonal is an edge; pixels within so many pixels of one weigh less.
    edge_step: float = 0.015
    edge_margin: float = 3.0
    #: Square blocks across the object in a photo, about: over a block errors of reflections that are misplaced by pixels cancel.
    blocks_across: int = 12


WEIGHTS = PixelWeights()
#: Offsets of supersampling rays from a pixel's centre, in pixels: a rotated grid, no two in one row or column.
SUBPIXEL_OFFSETS = ((-0.17, -0.5), (0.5, -0.17), (0.17, 0.5), (-0.5, 0.17))


@dataclass(frozen=True)
class Photo:
    """n pixels of one photo on the texels of one texture.

    `texel` (n, 4) indices of texels and their weights `bilinear` (n, 4); the mesh's `normal` (n, 3) there, of any length; `view` (n, 3)
    unit vectors from the surface to the camera; `colour` (n, 3) sRGB 0..1; `weight` (n,) 0..1; `block` (n,) index of the square block of
    the photo; `pixel` (n,) flat row-major index in the photo; `reflected` (n,) the texel that the reflected ray hits, -1: none, empty: not
    traced; `index` of the photo in the capture; `to_light` (3, 3) rotates directions to the frame of a light that moves (`light_motion`),
    None: it stands.
    """

    texel: NDArray[np.int32]
    bilinear: Floats
    normal: Floats
    view: Floats
    colour: Floats
    weight: Floats
    block: NDArray[np.int32]
    pixel: NDArray[np.int64]
    reflected: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    index: int = 0
    to_light: Doubles | None = None

    def __len__(self) -> int:
        return len(self.weight)

    @cached_property
    def dominant_texel(self) -> NDArray[np.int64]:
        """The texel (n,) with the largest bilinear weight in each pixel."""
        return np.take_along_axis(self.texel, self.bilinear.argmax(1)[:, None], 1)[:, 0].astype(np.int64)

    @cached_property
    def entries(self) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int32], Floats]:
        """The pixels of each texel: the texels `touched` (m,) in order, `start` (m + 1,) of their entries, `pixel` and `share` of each."""
        flat, share = self.texel.ravel(), self.bilinear.ravel()
        used = np.flatnonzero(share > 0)
        order = used[np.argsort(flat[used], kind="stable")]
        touched, start = np.unique(flat[order], return_index=True)
        return touched, np.append(start, len(order)), (order // 4).astype(np.int32), share[order]

    def rows(self, keep: NDArray[np.bool_] | slice) -> Photo:
        """The pixels to `keep`."""
        at = np.arange(len(self))[keep]
        return replace(
            self, texel=self.texel[at], bilinear=self.bilinear[at], normal=self.normal[at], view=self.view[at], colour=self.colour[at],
            weight=self.weight[at], block=self.block[at], pixel=self.pixel[at],
            reflected=self.reflected[at] if len(self.reflected) else self.reflected,
        )  # fmt: skip

    def every(self, step: int) -> Photo:
        """Every `step`-th pixel."""
        return self if step == 1 else self.rows(slice(None, None, step))

    def showing(self, chosen: NDArray[np.bool_]) -> Photo:
        """The pixels whose dominant texel is `chosen` (texels,)."""
        return self.rows(chosen[self.dominant_texel])

    def with_normals(self, normal: NDArray[np.floating]) -> Photo:
        """The same on a mesh whose texels have the `normal` (texels, 3)."""
        return replace(self, normal=interpolate(normal, self.texel, self.bilinear))

    def without_gain(self, gain: NDArray[np.floating], least: NDArray[np.floating]) -> Photo:
        """The pixels with the photo's exposure `gain` (3,) on linear colour divided out; `least` (3,) is that of the darkest photo.

        What is clipped in a brighter photo is only a lower bound: it hardly weighs.
        """
        brighter = bool((gain > BRIGHTER * least).any())
        if np.allclose(gain, 1) and not brighter:
            return self
        linear, weight = decode(self.colour), self.weight
        if brighter:
            weight = np.where((linear >= CLIPPED).any(1), BOUND_WEIGHT * weight, weight)
        return replace(self, colour=encode(linear / np.asarray(gain, np.float32)), weight=weight)

    def on_coarse_texels(self, texture: CoarseTexture, normal: NDArray[np.floating]) -> Photo:
        """One pixel of as many as a coarse texel of `texture` has fine ones, reading the coarse texels that contain these, which have the
        `normal` (m, 3)."""
        chosen, parent = self.every(_factor(texture) ** 2), coarse_texels(texture)
        found = parent[chosen.texel]
        bilinear = np.where(found >= 0, chosen.bilinear, 0).astype(np.float32)
        total = bilinear.sum(1)
        bilinear, texel = bilinear / np.maximum(total, 1e-6)[:, None], np.maximum(found, 0).astype(np.int32)
        reflected = np.where(chosen.reflected >= 0, parent[chosen.reflected], -1).astype(np.int32)
        weight = chosen.weight * (total > 0)
        normals = interpolate(normal, texel, bilinear)
        return replace(chosen, texel=texel, bilinear=bilinear, normal=normals, reflected=reflected, weight=weight)


def joined(photos: Sequence[Photo]) -> Photo:
    """All pixels of one or more `photos` under the same light, as if of one, with blocks of their own."""
    if len(photos) == 1:
        return photos[0]
    first = np.cumsum([0, *(int(photo.block.max(initial=-1)) + 1 for photo in photos)])
    names = "texel", "bilinear", "normal", "view", "colour", "weight", "pixel", "reflected"
    block = np.concatenate([photo.block + start for photo, start in zip(photos, first, strict=False)]).astype(np.int32)
    joint: dict[str, Any] = {name: np.concatenate([getattr(photo, name) for photo in photos]) for name in names}
    return replace(photos[0], block=block, **joint)


def coarse_texels(texture: CoarseTexture) -> NDArray[np.int64]:
    """The coarse texel (n,) that contains each fine one, -1: none."""
    factor = _factor(texture)
    row, column = np.divmod(texture.fine.index, texture.fine.size)
    return texture.texels.lookup[row // factor * texture.texels.size + column // factor]


def _factor(texture: CoarseTexture) -> int:
    """Edge of a coarse texel in fine ones."""
    return texture.fine.size // texture.texels.size


def texel_weight(photos: Iterable[Photo], count: int) -> Floats:
    """Total weight (count,) of the pixels of `photos` that show each texel."""
    weight = np.zeros(count)
    for photo in photos:
        touched, start, pixel, share = photo.entries
        if len(touched):
            weight[touched] += np.add.reduceat(share * photo.weight[pixel], start[:-1])
    return weight.astype(np.float32)


def interpolate(values: NDArray[np.floating], texel: NDArray[np.int32], bilinear: Floats) -> Floats:
    """`values` (texels, c) at pixels with the taps `texel` (n, 4) and weights `bilinear` (n, 4): (n, c)."""
    out = np.empty((len(texel), values.shape[1]), np.float32)
    interpolate_taps(np.ascontiguousarray(values, np.float32), np.ascontiguousarray(texel), np.ascontiguousarray(bilinear), out)
    return out


@dataclass(frozen=True)
class PhotoReader:
    """Reads photos of a mesh with `uv` (v, 2) (origin top left); `caster` holds the same triangles in the same order.

    The `texels` have the `normal` (texels, 3); `diagonal` of the object, in mesh units.
    """

    caster: RayCaster
    uv: NDArray[np.floating]
    texels: Texels
    normal: NDArray[np.floating]
    diagonal: float

    def read(
        self, camera: Camera, rgb: NDArray[np.uint8], mask: NDArray[np.uint8] | None, max_pixels: int | None = None, index: int = 0
    ) -> Photo:
        """The pixels of a photo (h, w, 3) sRGB that show the mesh, inside its `mask` (h, w; 255: object) if there is one: every second,
        third … one, so that there are at most `max_pixels`. `index` of the photo in the capture."""
        w, (height, width) = WEIGHTS, rgb.shape[:2]
        rays = camera.rays().reshape(-1, 3)
        mask_distance = np.full((height, width), 1e6, np.float32)
        if mask is not None:
            mask_distance = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 5).astype(np.float32)
        pixel = np.flatnonzero(mask_distance.ravel() > w.mask_margin[0])
        hits = self.caster.first_hit(camera.centre[None], rays[pixel])
        depth = np.zeros(height * width, np.float32)
        depth[pixel[hits.hit]] = hits.distance[hits.hit]
        edge_weight = edge_weights(depth.reshape(height, width), w.edge_step * self.diagonal, w.edge_margin).ravel()

        corner = self.caster.vertices[self.caster.faces[np.maximum(hits.face, 0)]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
        view = -rays[pixel] / np.linalg.norm(rays[pixel], axis=1, keepdims=True)
        cosine = np.einsum("nk,nk->n", normal, view)
        chosen = np.flatnonzero(hits.hit & (cosine > w.cosine[0]))
        texel, bilinear = self._bilinear_taps(_hit_uv(self, hits.bary[chosen], hits.face[chosen]))
        known = bilinear.sum(1) > 0
        chosen, texel, bilinear = chosen[known], texel[known], bilinear[known]
        at = pixel[chosen]
        weight = _ramp(mask_distance.ravel()[at], *w.mask_margin) * _ramp(cosine[chosen], *w.cosine) * edge_weight[at]
        colour = rgb.reshape(-1, 3)[at].astype(np.float32) / 255
        side = max(1, int(np.sqrt(len(at)) / w.blocks_across))
        block = at // width // side * (width // side + 1) + at % width // side
        photo = Photo(
            texel, bilinear, np.zeros_like(colour), view[chosen].astype(np.float32), colour, weight.astype(np.float32),
            block.astype(np.int32), at, index=index,
        )  # fmt: skip
        return photo.every(1 if max_pixels is None else max(1, -(-len(at) // max_pixels))).with_normals(self.normal)

    def subpixel_texels(self, camera: Camera, pixel: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The texels (n, len(SUBPIXEL_OFFSETS)) hit by supersampling rays of each `pixel` (n,), and which lie at its front depth."""
        column, row = pixel % camera.width + 0.5 - camera.cx, pixel // camera.width + 0.5 - camera.cy
        texel = np.zeros((len(pixel), len(SUBPIXEL_OFFSETS)), np.int64)
        distance = np.full((len(pixel), len(SUBPIXEL_OFFSETS)), np.inf, np.float32)
        for k, (dx, dy) in enumerate(SUBPIXEL_OFFSETS):
            rays = np.stack([(column + dx) / camera.fx, (row + dy) / camera.fy, np.ones(len(pixel))], 1) @ camera.R
            hits = self.caster.first_hit(camera.centre[None], rays)
            found = self.texels.containing(_hit_uv(self, hits.bary, np.maximum(hits.face, 0)))
            valid = hits.hit & (found >= 0)
            texel[:, k], distance[valid, k] = np.maximum(found, 0), hits.distance[valid]
        return texel, distance < distance.min(1, keepdims=True) + WEIGHTS.edge_step * self.diagonal

    def with_reflections(self, photo: Photo, position: NDArray[np.floating], offset: float) -> Photo:
        """The photo with the texel that the reflected ray of each pixel hits: one ray per pixel, as mesh and cameras do not change.

        `position` (texels, 3); rays start `offset` above the surface (mesh units). A smooth lobe reflects the environment where the ray is
        unoccluded, else that texel; how far a rough lobe follows the ray is decided in shading (`reflection_kernel.specular_visibility`).
        """
        at, shading = (np.einsum("nk,nkd->nd", photo.bilinear, x[photo.texel]) for x in (position, self.normal))
        face = self.texels.face[photo.dominant_texel]
        sent, hits = trace_reflections(self.caster, face, at, shading, photo.view, offset)
        reflected = np.full(len(photo), -1, np.int32)
        reflected[sent[hits.hit]] = self.texels.containing(_hit_uv(self, hits.bary[hits.hit], hits.face[hits.hit]))
        return replace(photo, reflected=reflected)

    def _bilinear_taps(self, uv: Doubles) -> tuple[NDArray[np.int32], Floats]:
        """The four texels around each texture coordinate (n, 2) and their weights, 0 for texels outside the charts."""
        x, y = uv[:, 0] * self.texels.size - 0.5, uv[:, 1] * self.texels.size - 0.5
        left, top = np.floor(x), np.floor(y)
        fx, fy = x - left, y - top
        texel = np.zeros((len(uv), 4), np.int32)
        weight = np.zeros((len(uv), 4), np.float32)
        for k, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            column = np.clip(left + dx, 0, self.texels.size - 1).astype(np.int64)
            row = np.clip(top + dy, 0, self.texels.size - 1).astype(np.int64)
            found = self.texels.lookup[row * self.texels.size + column]
            part = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
            weight[:, k] = np.where(found >= 0, part, 0)
            texel[:, k] = np.maximum(found, 0)
        total = weight.sum(1, keepdims=True)
        return texel, np.divide(weight, total, out=np.zeros_like(weight), where=total > 1e-6)


def _hit_uv(reader: PhotoReader, bary: NDArray[np.floating], face: NDArray[np.integer]) -> Doubles:
    """Texture coordinates (n, 2) at the barycentrics (n, 3) of faces (n,)."""
    return np.asarray(np.einsum("nk,nkd->nd", bary, np.asarray(reader.uv, np.float64)[reader.caster.faces[face]]))


def _ramp(value: NDArray[np.floating], low: float, high: float) -> NDArray[np.floating]:
    """0 at `low`, 1 from `high` on, linear between."""
    return np.clip((value - low) / (high - low), 0, 1)


#: Surface points compared, about.
SURFACE_POINTS = 6000
#: Least cosine between a point's normal and the view (70 degrees), and least distance in pixels inside the mask.
MIN_COSINE, MASK_MARGIN = 0.35, 2
#: Rays start this share of the object's diagonal above the surface.
RAY_OFFSET = 2e-3


def visible_on_mesh(
    camera: Camera, mask: NDArray[np.uint8] | None, points: Array, normals: Array, caster: RayCaster, diagonal: float
) -> NDArray[np.bool_]:
    """Which `points` (k, 3) with outward `normals` (k, 3) face `camera`, lie in its `mask` (h, w) and are unoccluded."""
    visible = caster.visible_from(camera, points, normals, MIN_COSINE, RAY_OFFSET * diagonal)
    if mask is not None:
        inner = cv2.erode(mask, np.ones((2 * MASK_MARGIN + 1, 2 * MASK_MARGIN + 1), np.uint8))
        column, row = np.floor(camera.project(points[visible])[0]).astype(np.int64).T
        visible[np.flatnonzero(visible)] = inner[row, column] > 127
    return visible


class MeshBrightness:
    """Brightness of `points` (k, 3) on the mesh of `caster`, with outward `normals` (k, 3), in photos that are added one by one."""

    def __init__(self, points: NDArray[Any], normals: NDArray[Any], caster: RayCaster, diagonal: float) -> None:
        self._brightness = SurfaceBrightness(np.asarray(points, np.float64))
        self._normals = np.asarray(normals, np.float64)
        self._caster, self._diagonal = caster, diagonal

    def add(self, view: View) -> None:
        """Add one photo."""
        visible = visible_on_mesh(view.camera, view.mask, self._brightness.points, self._normals, self._caster, self._diagonal)
        self._brightness.add(view.camera, view.rgb, visible)

    def statistics(self) -> tuple[BrightnessStatistics, float]:
        """Statistics of the points compared, and their share of all points."""
        statistics = self._brightness.statistics()
        return statistics, statistics.points / max(1, len(self._normals))
