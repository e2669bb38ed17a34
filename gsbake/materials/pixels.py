"""What the photos show of the texture, pixel by pixel: each pixel's texels, view direction, colour and weight.

A ray through each pixel's centre meets the mesh once; from then on a photo is a list of bilinear texture reads, and fitting a texture to
photos needs no rasteriser. Where a texture is finer than the photos, a pixel is an average of several texels instead, found by rays
spread over it (`samples`). Pixels near a mask's border, near depth edges and at grazing views count less: there a small error of shape
shows another part of the surface.
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

#: Pixels whose view is flatter than the first cosine are left out; from the second on they count fully.
GRAZING = (0.15, 0.4)
#: Pixels to the mask's border: nearer than the first are left out, from the second on they count fully.
BORDER = (1.5, 4.0)
#: A depth step larger than this share of the object's diagonal is an edge; pixels within this many pixels of one count less.
EDGE_STEP, EDGE_PIXELS = 0.015, 3.0
#: About so many blocks side by side show the object in a photo.
BLOCKS = 12
#: Where in a pixel the rays of an average go, in pixels from its centre: the corners of a turned square, no two in one row or column.
SAMPLES = ((-0.17, -0.5), (0.5, -0.17), (0.17, 0.5), (-0.5, 0.17))


@dataclass(frozen=True)
class Pixels:
    """n pixels of one photo.

    `texel` (n, 4) int64 indices into the texels and `share` (n, 4) their bilinear weights; `towards` (n, 3) unit vectors from the surface
    to the camera; `colour` (n, 3) sRGB 0..1; `weight` (n,) 0..1; `block` (n,) which square block of the photo each lies in; `pixel` (n,)
    flat row-major index in the photo; `met` (n,) the texel that the mirrored view meets, -1: none, None: not traced.
    """

    texel: NDArray[np.int64]
    share: Floats
    towards: Floats
    colour: Floats
    weight: Floats
    block: NDArray[np.int32]
    pixel: NDArray[np.int64]
    met: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.weight)

    def thinned(self, most: int) -> Pixels:
        """Every second, third … pixel, so that at most `most` are left."""
        step = max(1, -(-len(self) // most))
        every = {field.name: getattr(self, field.name) for field in fields(self)}
        kept: Any = {name: None if part is None else part[::step] for name, part in every.items()}
        return Pixels(**kept)

    def without_gain(self, gain: NDArray[Any]) -> Pixels:
        """The same pixels with a photo's `gain` (3,) of linear colour divided out."""
        if np.allclose(gain, 1):
            return self
        return replace(self, colour=encode(decode(self.colour) / np.asarray(gain, np.float32)))


class PixelReader:
    """Reads photos of a mesh with `uv` (v, 2) (origin top left) and `faces` (f, 3); `caster` holds the same triangles in the same order."""

    def __init__(self, caster: RayCaster, uv: NDArray[Any], texels: Texels, diagonal: float) -> None:
        self._caster, self._uv, self._texels, self._diagonal = caster, np.asarray(uv, np.float64), texels, diagonal

    def read(self, camera: Camera, rgb: NDArray[np.uint8], mask: NDArray[np.uint8] | None) -> Pixels:
        """The pixels of a photo (h, w, 3) that show the mesh, inside its `mask` (h, w; 255: object) when there is one."""
        height, width = rgb.shape[:2]
        rays = camera.rays().reshape(-1, 3)
        inside = np.full((height, width), 1e6, np.float32)
        if mask is not None:
            inside = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 5).astype(np.float32)
        pixel = np.flatnonzero(inside.ravel() > BORDER[0])
        hits = self._caster.first_hit(camera.centre[None], rays[pixel])
        depth = np.zeros(height * width, np.float32)
        depth[pixel[hits.hit]] = hits.distance[hits.hit]
        beside = edge_weights(depth.reshape(height, width), EDGE_STEP * self._diagonal, EDGE_PIXELS).ravel()

        corner = self._caster.vertices[self._caster.faces[np.maximum(hits.face, 0)]]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
        towards = -rays[pixel] / np.linalg.norm(rays[pixel], axis=1, keepdims=True)
        cosine = np.einsum("nk,nk->n", normal, towards)
        chosen = np.flatnonzero(hits.hit & (cosine > GRAZING[0]))
        uv = np.einsum("nk,nkd->nd", hits.bary[chosen], self._uv[self._caster.faces[hits.face[chosen]]])
        texel, share = self._taps(uv)
        known = share.sum(1) > 0
        chosen, texel, share = chosen[known], texel[known], share[known]
        at = pixel[chosen]
        weight = _ramp(inside.ravel()[at], *BORDER) * _ramp(cosine[chosen], *GRAZING) * beside[at]
        colour = rgb.reshape(-1, 3)[at].astype(np.float32) / 255
        side = max(1, int(np.sqrt(len(at)) / BLOCKS))
        block = at // width // side * (width // side + 1) + at % width // side
        return Pixels(texel, share, towards[chosen].astype(np.float32), colour, weight.astype(np.float32), block.astype(np.int32), at)

    def samples(self, camera: Camera, pixel: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The texels (n, len(SAMPLES)) that rays spread over each `pixel` (n,) meet, and which of these rays met it at the same depth."""
        column, row = pixel % camera.width + 0.5 - camera.cx, pixel // camera.width + 0.5 - camera.cy
        texel = np.zeros((len(pixel), len(SAMPLES)), np.int64)
        distance = np.full((len(pixel), len(SAMPLES)), np.inf, np.float32)
        for k, (dx, dy) in enumerate(SAMPLES):
            rays = np.stack([(column + dx) / camera.fx, (row + dy) / camera.fy, np.ones(len(pixel))], 1) @ camera.R
            hits = self._caster.first_hit(camera.centre[None], rays)
            uv = np.einsum("nk,nkd->nd", hits.bary, self._uv[self._caster.faces[np.maximum(hits.face, 0)]])
            slot = self._texels.holding(uv)
            met = hits.hit & (slot >= 0)
            texel[:, k], distance[met, k] = np.maximum(slot, 0), hits.distance[met]
        return texel, distance < distance.min(1, keepdims=True) + EDGE_STEP * self._diagonal

    def _taps(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.int64], Floats]:
        """The four texels around each texture coordinate (n, 2) and their weights; texels off the charts take no part."""
        x, y = uv[:, 0] * self._texels.size - 0.5, uv[:, 1] * self._texels.size - 0.5
        left, top = np.floor(x), np.floor(y)
        fx, fy = x - left, y - top
        texel = np.zeros((len(uv), 4), np.int64)
        share = np.zeros((len(uv), 4), np.float32)
        for k, (dx, dy) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            column = np.clip(left + dx, 0, self._texels.size - 1).astype(np.int64)
            row = np.clip(top + dy, 0, self._texels.size - 1).astype(np.int64)
            slot = self._texels.slot[row * self._texels.size + column]
            part = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
            share[:, k] = np.where(slot >= 0, part, 0)
            texel[:, k] = np.maximum(slot, 0)
        total = share.sum(1, keepdims=True)
        return texel, np.divide(share, total, out=np.zeros_like(share), where=total > 1e-6)


def _ramp(value: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    """0 at `low`, 1 from `high` on, linear between."""
    return np.clip((value - low) / (high - low), 0, 1)
