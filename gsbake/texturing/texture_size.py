"""Edge of the base colour from evidence: texels about as fine as the finest pixels with which the photos see the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Doubles = NDArray[np.float64]

#: Texels of the surface at which the photos' pixels are measured.
POINTS = 2000
#: Share of the seen surface that has pixels at least as fine as those the texture is made for: close-ups of a small part do not decide.
FINEST_SHARE = 0.25
#: Smallest cosine between a ray and the normal: more oblique views are not sharp. Height by which rays start above the surface, as a share
#: of the mesh's diagonal.
MIN_COSINE, LIFT = 0.5, 1e-3
#: Largest edge.
LARGEST = 4096
#: Bytes per texel: of a colour in the asset's PNG file, at most.
FILE_BYTES = 3


@dataclass(frozen=True)
class TextureSize:
    """Edge `size` of the base colour in texels, and the `exact` one, at which texels are as fine as pixels (0: no photo sees the mesh)."""

    size: int
    exact: float

    @property
    def evidence(self) -> str:
        """What it was chosen by, and what it costs."""
        return f"the photos' pixels fill {self.exact:.0f}² texels; its file has at most {self.size**2 * FILE_BYTES / 1e6:.0f} MB"


def texture_size(cameras: Sequence[Camera], surface: UnwrappedMesh) -> TextureSize:
    """The edge for a `surface` with texels of the least edge, seen by pinhole `cameras` of the full photos in its frame.

    The nearest power of two: texels are between .7 and 1.4 pixels wide.
    """
    least = surface.texels.size
    chosen = np.linspace(0, len(surface.texels) - 1, POINTS).round().astype(np.int64)
    position, normal = (np.asarray(values[chosen], np.float64) for values in (surface.texel_position, surface.texel_normal))
    finest = _finest_pixels(cameras, surface, position, normal)
    seen = np.isfinite(finest)
    if not seen.any():
        return TextureSize(least, 0.0)
    exact = surface.texel_size * least / float(np.quantile(finest[seen], FINEST_SHARE))
    return TextureSize(int(np.clip(2 ** round(np.log2(exact)), least, max(least, LARGEST))), exact)


def _finest_pixels(cameras: Sequence[Camera], surface: UnwrappedMesh, points: Doubles, normals: Doubles) -> Doubles:
    """Width (n,) on the surface of the finest pixel that shows each of `points` (n, 3); infinite where none does."""
    finest = np.full(len(points), np.inf)
    for camera in cameras:
        pixels, depth = camera.project(points)
        to_camera = camera.centre - points
        cosine = (to_camera * normals).sum(1) / np.linalg.norm(to_camera, axis=1)
        rows = np.flatnonzero(camera.in_view(pixels, depth) & (cosine >= MIN_COSINE))
        rows = rows[~surface.caster.occluded(points[rows] + LIFT * surface.diagonal * normals[rows], to_camera[rows])]
        # A pixel is a square of depth / focal length, longer by the cosine in one direction.
        finest[rows] = np.minimum(finest[rows], depth[rows] / np.sqrt(camera.fx * camera.fy * cosine[rows]))
    return finest
