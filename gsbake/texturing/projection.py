"""Projective texturing: views projected onto the texture and fused robustly.

Views are added one at a time. Each texel visible in a view gets a weight: pixels per area (viewing angle and distance), distance to depth
edges and silhouettes, and the view's own weight image. The `VIEWS_PER_TEXEL` best views of a texel are stored. At the end an exposure gain
per view and channel may be divided out; a texel's value is the mean of its views near their weighted median, the best ones weighted most:
highlights, occluders and misaligned edges are rejected, detail stays as sharp as in the best photos.

Weights after Callieri et al., *Masked photo blending*, Computers & Graphics 2008; robust fusion as a weighted median followed by one
reweighted mean (an M-estimator's step).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.kernels.threads import run_chunks
from gsbake.texturing.gather_kernel import gather
from gsbake.texturing.view_fusion import CLIPPED, fuse, log_samples

Floats = NDArray[np.float32]

#: Best views stored per texel.
VIEWS_PER_TEXEL = 10
#: Longer side of the depth maps for visibility, in pixels.
DEPTH_SIZE = 800
#: Within this share of the depth map's longer side from a depth edge, a view weighs less.
EDGE_MARGIN = 0.008
#: A depth step larger than this share of the object's diagonal is an edge.
EDGE_STEP = 0.015
#: Photos are reduced to the size of texels that are at least so many pixels wide.
FINER = 1.5
#: Weight of a clipped value that is only a lower bound.
BOUND_WEIGHT = np.float32(0.01)
#: A view whose gain is that many times the least is brighter.
BRIGHTER = 1.05
#: A texel may lie behind the depth map by this share of the object's diagonal.
DEPTH_SLACK = 0.003


@dataclass(frozen=True)
class ProjectedTexture:
    """Fused views: `values` (n, c) float32; number of stored `views` (n,) of each texel (0: unobserved); `confidence` (n,) 0..1; `gains`
    (views, c) divided out of the views."""

    values: Floats
    views: NDArray[np.int32]
    confidence: Floats
    gains: Floats

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Texels (n,) that at least one view shows."""
        return self.views > 0


class ProjectionBlender:
    """Fuses images of `channels` channels into n texels with `position` (n, 3) and unit `normal` (n, 3).

    `caster` holds the mesh of the texels; `texel_size` is the edge of a texel in mesh units, used to filter photos finer than the texture.
    Where the texels are a part of the surface, `whole` (m, 3) are points of all of it: all parts filter photos the same way.
    """

    def __init__(
        self,
        position: NDArray[Any],
        normal: NDArray[Any],
        caster: RayCaster,
        channels: int,
        texel_size: float,
        whole: NDArray[Any] | None = None,
    ) -> None:
        self._whole = np.asarray(position if whole is None else whole, np.float32)
        self._position = np.ascontiguousarray(position, np.float32)
        self._normal = np.ascontiguousarray(normal, np.float32)
        self._caster = caster
        self._texel_size = texel_size
        self._diagonal = float(np.linalg.norm(np.ptp(caster.vertices, axis=0))) if len(caster.vertices) else 1.0
        n = len(self._position)
        self._values = np.zeros((n, VIEWS_PER_TEXEL, channels), np.uint16)
        self._weights = np.zeros((n, VIEWS_PER_TEXEL), np.float32)
        self._view = np.full((n, VIEWS_PER_TEXEL), -1, np.int16)
        self._count = 0

    def add(self, camera: Camera, image: NDArray[Any], weight_image: NDArray[Any] | None = None, weight: float = 1.0) -> int:
        """Project one view; returns the number of texels it shows.

        `image` (h, w, c) is linear in 0..1, of the size of `camera`, which is in the texels' frame.
        `weight_image` (h, w) 0..1 multiplies the weights of pixels (0: never use the pixel), `weight` that of the whole view.
        """
        pixels = np.asarray(image, np.float32)
        mask = np.ones(pixels.shape[:2], np.float32) if weight_image is None else np.asarray(weight_image, np.float32)
        camera, pixels, mask = self._filtered(camera, pixels, mask)
        longer = max(camera.width, camera.height)
        shrink = min(1.0, DEPTH_SIZE / longer)
        small = camera.scaled(max(2, round(camera.width * shrink)), max(2, round(camera.height * shrink)))
        depth = self._caster.depth(small)
        edge = edge_weights(depth, EDGE_STEP * self._diagonal, EDGE_MARGIN * max(small.width, small.height))
        pose = np.concatenate([camera.R, camera.t[:, None]], 1)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        args = (
            self._position, self._normal, pose, camera.centre, lens, np.ascontiguousarray(pixels), np.ascontiguousarray(mask),
            depth, edge, DEPTH_SLACK * self._diagonal, weight, np.int16(self._count), self._values, self._weights, self._view,
        )  # fmt: skip
        shown = run_chunks(lambda lo, hi: gather(lo, hi, *args), len(self._position))
        self._count += 1
        return sum(shown)

    def result(self, gains: Floats | None = None) -> ProjectedTexture:
        """Fuse the views added, their exposure `gains` (views, c) divided out.

        What is clipped in a view that is brighter than the darkest is only a lower bound: it hardly weighs.
        """
        gains = np.ones((max(self._count, 1), self._values.shape[2]), np.float32) if gains is None else gains
        weights, brighter = self._weights, (gains > BRIGHTER * gains.min(0)).any(1)
        if brighter.any():
            bound = (self._values >= 65535 * CLIPPED**0.5).any(2) & brighter[np.maximum(self._view, 0)]
            weights = np.where(bound, BOUND_WEIGHT * weights, weights)
        values, views, confidence = fuse(self._values, weights, self._view, gains)
        return ProjectedTexture(values, views, confidence, gains)

    def log_samples(self) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Logarithms of samples, their views and texels (`view_fusion.log_samples`)."""
        return log_samples(self._values, self._weights, self._view)

    def samples(self, rows: NDArray[np.int64], gains: Floats) -> tuple[NDArray[np.float64], Floats, NDArray[np.int16]]:
        """Linear samples (m, keep, c) of the texels `rows` (m,), the views' `gains` (views, c) divided out, with their weights (m, keep)
        and views (m, keep; -1: none)."""
        view = self._view[rows]
        return (self._values[rows] / 65535.0) ** 2 / gains[view], self._weights[rows], view

    def useful_size(self, camera: Camera) -> int:
        """Longer side in pixels at which pixels are as fine as texels, rounded up; that of `camera` where they are not much finer:
        a filter would blur them."""
        longer, width = max(camera.width, camera.height), self._texel_width(camera)
        return longer if width < FINER else int(np.ceil(longer / width))

    def _texel_width(self, camera: Camera) -> float:
        """Width in pixels of a texel at the median depth; 0 when all lie behind the camera."""
        offset = self._whole[:: max(1, len(self._whole) // 2000)] - camera.centre.astype(np.float32)
        depth = offset @ camera.R[2].astype(np.float32)
        depth = depth[depth > 0]
        return self._texel_size * camera.fx / float(np.median(depth)) if len(depth) else 0.0

    def _filtered(self, camera: Camera, pixels: Floats, mask: Floats) -> tuple[Camera, Floats, Floats]:
        """The view reduced by an area filter when its pixels are much finer than texels, against aliasing."""
        texel_width = self._texel_width(camera)
        if texel_width < FINER:
            return camera, pixels, mask
        size = (max(2, round(camera.width / texel_width)), max(2, round(camera.height / texel_width)))
        # Plane by plane: OpenCV's area filter takes at most four channels.
        planes = [cv2.resize(np.ascontiguousarray(pixels[..., c]), size, interpolation=cv2.INTER_AREA) for c in range(pixels.shape[2])]
        reduced = np.asarray(np.stack(planes, 2), np.float32)
        return camera.scaled(*size), reduced, np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_AREA), np.float32)


def edge_weights(depth: NDArray[Any], step: float, margin: float) -> Floats:
    """Weights (h, w) 0..1 that fall to a small minimum within `margin` pixels of a step larger than `step` in `depth` (h, w; 0: nothing).

    The minimum is not 0, so that a thin part, all of it near an edge, is still textured.
    """
    z = np.where(depth > 0, depth, np.float32(1e6)).astype(np.float32)
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(z, axis=axis)) > step
        before = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        after = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        edge[before] |= jump
        edge[after] |= jump
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5)
    return _ramp(distance, margin)


def mask_weights(mask: NDArray[np.uint8], margin: float) -> Floats:
    """Weights (h, w) from an object mask (255: object): 0 outside, rising to 1 at `margin` pixels inside."""
    distance = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 5)
    return np.where(distance > 0, _ramp(distance, margin), np.float32(0))


def _ramp(distance: NDArray[Any], margin: float) -> Floats:
    """Weight (h, w) 0..1 that rises to 1 at `margin`; distances may be the largest number, where there is nothing to be distant from."""
    margin = max(margin, 1e-6)
    return np.asarray(np.clip(np.minimum(distance, np.float32(margin)) / np.float32(margin), 0.02, 1) ** 2, np.float32)
