"""The pixels of a photo as bilinear reads of the texture: texels, view direction, colour and weight of each pixel.

A ray through each pixel's centre meets the mesh once; from then on a photo is a list of texture reads, and the fit needs no rasteriser.
Where a texture is finer than the photos, a pixel is an average of several texels, found by supersampling (`subpixel_texels`). Pixels near
a mask's boundary, near depth edges and at grazing views weigh less: there a small error of shape shows another part of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode, encode
from gsbake.texturing.projection import edge_weights
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]

#: Cosines between view and face normal: pixels below the first are skipped, from the second on they have full weight.
COSINE_RANGE = (0.15, 0.4)
#: Distances to the mask's boundary in pixels: pixels below the first are skipped, from the second on they have full weight.
MASK_MARGIN = (1.5, 4.0)
#: A depth step larger than this share of the object's diagonal is an edge; pixels within this many pixels of one weigh less.
EDGE_STEP, EDGE_MARGIN = 0.015, 3.0
#: Square blocks across the object in a photo, about.
BLOCKS_ACROSS = 12
#: Offsets of supersampling rays from a pixel's centre, in pixels: a rotated grid, no two in one row or column.
SUBPIXEL_OFFSETS = ((-0.17, -0.5), (0.5, -0.17), (0.17, 0.5), (-0.5, 0.17))


@dataclass(frozen=True)
class Pixels:
    """n pixels of one photo.

    `texel` (n, 4) int64 indices of texels and their weights `bilinear` (n, 4); `view` (n, 3) unit vectors from the surface to the camera;
    `colour` (n, 3) sRGB 0..1; `weight` (n,) 0..1; `block` (n,) index of the square block of the photo; `pixel` (n,) flat row-major index
    in the photo; `reflected_texel` (n,) the texel that the reflected ray hits, -1: none, None: not traced; `to_light` (3, 3) rotates
    directions to the frame of a light that moves (`light_motion`), None: it stands.
    """

    texel: NDArray[np.int64]
    bilinear: Floats
    view: Floats
    colour: Floats
    weight: Floats
    block: NDArray[np.int32]
    pixel: NDArray[np.int64]
    reflected_texel: NDArray[np.int64] | None = None
    to_light: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.weight)

    def subsampled(self, max_count: int) -> Pixels:
        """Every second, third … pixel, at most `max_count` of them."""
        return self.every(max(1, -(-len(self) // max_count)))

    def every(self, step: int) -> Pixels:
        """Every `step`-th pixel."""
        every = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "to_light"}
        chosen: Any = {name: None if part is None else part[::step] for name, part in every.items()}
        return Pixels(**chosen, to_light=self.to_light)

    def without_gain(self, gain: NDArray[Any]) -> Pixels:
        """The pixels with the photo's exposure `gain` (3,) on linear colour divided out."""
        if np.allclose(gain, 1):
            return self
        return replace(self, colour=encode(decode(self.colour) / np.asarray(gain, np.float32)))


class PixelReader:
    """Reads photos of a mesh with `uv` (v, 2) (origin top left) and `faces` (f, 3); `caster` holds the same triangles in the same order."""

    def __init__(self, caster: RayCaster, uv: NDArray[Any], texels: Texels, diagonal: float) -> None:
        self._caster, self._uv, self._texels, self._diagonal = caster, np.asarray(uv, np.float64), texels, diagonal

    def read(self, camera: Camera, rgb: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> Pixels:
        """The pixels of a photo (h, w, 3) sRGB that show the mesh, inside its `mask` (h, w; 255: object) if there is one."""
        height, width = rgb.shape[:2]
        rays = camera.rays().reshape(-1, 3)
        mask_distance = np.full((height, width), 1e6, np.float32)
        if mask is not None:
            mask_distance = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 5).astype(np.float32)
        pixel = np.flatnonzero(mask_distance.ravel() > MASK_MARGIN[0])
        hits = self._caster.first_hit(camera.centre[None], rays[pixel])
        depth = np.zeros(height * width, np.float32)
        depth[pixel[hits.hit]] = hits.distance[hits.hit]
        edge_weight = edge_weights(depth.reshape(height, width), EDGE_STEP * self._diagonal, EDGE_MARGIN).ravel()

        corner = self._caster.vertices[self._caster.faces[np.maximum(hits.face, 0)]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
        view = -rays[pixel] / np.linalg.norm(rays[pixel], axis=1, keepdims=True)
        cosine = np.einsum("nk,nk->n", normal, view)
        chosen = np.flatnonzero(hits.hit & (cosine > COSINE_RANGE[0]))
        uv = np.einsum("nk,nkd->nd", hits.bary[chosen], self._uv[self._caster.faces[hits.face[chosen]]])
        texel, bilinear = self._bilinear_taps(uv)
        known = bilinear.sum(1) > 0
        chosen, texel, bilinear = chosen[known], texel[known], bilinear[known]
        at = pixel[chosen]
        weight = _ramp(mask_distance.ravel()[at], *MASK_MARGIN) * _ramp(cosine[chosen], *COSINE_RANGE) * edge_weight[at]
        colour = rgb.reshape(-1, 3)[at].astype(np.float32) / 255
        side = max(1, int(np.sqrt(len(at)) / BLOCKS_ACROSS))
        block = at // width // side * (width // side + 1) + at % width // side
        return Pixels(texel, bilinear, view[chosen].astype(np.float32), colour, weight.astype(np.float32), block.astype(np.int32), at)

    def subpixel_texels(self, camera: Camera, pixel: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The texels (n, len(SUBPIXEL_OFFSETS)) hit by supersampling rays of each `pixel` (n,), and which lie at its front depth."""
        column, row = pixel % camera.width + 0.5 - camera.cx, pixel // camera.width + 0.5 - camera.cy
        texel = np.zeros((len(pixel), len(SUBPIXEL_OFFSETS)), np.int64)
        distance = np.full((len(pixel), len(SUBPIXEL_OFFSETS)), np.inf, np.float32)
        for k, (dx, dy) in enumerate(SUBPIXEL_OFFSETS):
            rays = np.stack([(column + dx) / camera.fx, (row + dy) / camera.fy, np.ones(len(pixel))], 1) @ camera.R
            hits = self._caster.first_hit(camera.centre[None], rays)
            uv = np.einsum("nk,nkd->nd", hits.bary, self._uv[self._caster.faces[np.maximum(hits.face, 0)]])
            found = self._texels.containing(uv)
            valid = hits.hit & (found >= 0)
            texel[:, k], distance[valid, k] = np.maximum(found, 0), hits.distance[valid]
        return texel, distance < distance.min(1, keepdims=True) + EDGE_STEP * self._diagonal

    def _bilinear_taps(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.int64], Floats]:
        """The four texels around each texture coordinate (n, 2) and their weights, 0 for texels outside the charts."""
        x, y = uv[:, 0] * self._texels.size - 0.5, uv[:, 1] * self._texels.size - 0.5
        left, top = np.floor(x), np.floor(y)
        fx, fy = x - left, y - top
        texel = np.zeros((len(uv), 4), np.int64)
        weight = np.zeros((len(uv), 4), np.float32)
        for k, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            column = np.clip(left + dx, 0, self._texels.size - 1).astype(np.int64)
            row = np.clip(top + dy, 0, self._texels.size - 1).astype(np.int64)
            found = self._texels.lookup[row * self._texels.size + column]
            part = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
            weight[:, k] = np.where(found >= 0, part, 0)
            texel[:, k] = np.maximum(found, 0)
        total = weight.sum(1, keepdims=True)
        return texel, np.divide(weight, total, out=np.zeros_like(weight), where=total > 1e-6)


def _ramp(value: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    """0 at `low`, 1 from `high` on, linear between."""
    return np.clip((value - low) / (high - low), 0, 1)
