"""Visual hull of a masked object, as a signed distance on a grid.

Laurentini, *The visual hull concept* (PAMI 1994): the largest shape that no silhouette excludes. Instead of a binary occupancy each view
gives a signed distance (pixels from the silhouette's edge, times depth over focal length), and the hull's value is the maximum:
the surface has subcell precision and smooth normals. Two tolerances for real captures: a point outside a photo's frame is
*unknown* to that photo, not empty (an object cut off by the frame stays whole), and a few views may disagree, since masks have holes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.rays import camera_arrays, concatenate_images
from gsbake.capture.photos.decode import Bytes
from gsbake.geometry.cameras import Array, Camera
from gsbake.imaging.distance import distance_to_zero
from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks

if TYPE_CHECKING:
    from gsbake.capture.posed_photos import PosedPhotos

Floats = NDArray[np.float32]

#: Share of the views of a point, rounded, that may exclude it although it belongs to the object.
MAX_INCONSISTENT_SHARE = 0.03
#: A point inside the frames of fewer than this share of the views (or of fewer than 2) is outside the hull.
MIN_VISIBLE_SHARE = 0.25
#: Number of largest distances kept per point under that share; bounds how many views may be inconsistent in large captures.
_MAX_RANKED = 8
#: Cells from the surface beyond which the distance outside is only a lower bound.
_EXACT_BAND = 6.0


@kernel(
    "i8, i8, f4[::1], i8[::1], i8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1], f8, f8, i8, i8, f4[:, :, ::1]",
    nogil=True, error_model="numpy",
)
def _carve(
    lo: int, hi: int, distance: Floats, starts: NDArray[np.int64], sizes: NDArray[np.int64], intrinsics: Array, poses: Array,
    lower: Array, cell: float, max_inconsistent_share: float, max_ranked: int, min_visible: int, out: Floats,
) -> None:  # fmt: skip
    """Write the signed distance at cell centres, negative inside, to the layers lo..hi of `out` (n, n, n).

    distance: concatenated signed pixel distances (positive outside) of all views; starts (v,), sizes (v, 2) as h, w;
    intrinsics (v, 4) fx, fy, cx, cy; poses (v, 3, 4) world→camera.
    """
    views = starts.shape[0]
    max_inconsistent = min(int(max_inconsistent_share * views + 0.5), max_ranked - 1)
    far = _EXACT_BAND * cell
    n = out.shape[1]
    largest = np.empty(max_ranked, np.float64)
    for i in range(lo, hi):
        x = lower[0] + (i + 0.5) * cell
        for j in range(n):
            y = lower[1] + (j + 0.5) * cell
            for k in range(n):
                z = lower[2] + (k + 0.5) * cell
                visible = 0
                largest[:] = -1e30
                for v in range(views):
                    p = poses[v]
                    depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                    if depth <= 1e-9:
                        continue
                    u = intrinsics[v, 0] * (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth + intrinsics[v, 2] - 0.5
                    w = intrinsics[v, 1] * (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth + intrinsics[v, 3] - 0.5
                    height, width = sizes[v, 0], sizes[v, 1]
                    if not (u >= 0 and w >= 0 and u < width - 1 and w < height - 1):
                        continue
                    iu, iw = int(u), int(w)
                    fu, fw = u - iu, w - iw
                    base = starts[v] + iw * width + iu
                    top = distance[base] * (1 - fu) + distance[base + 1] * fu
                    bottom = distance[base + width] * (1 - fu) + distance[base + width + 1] * fu
                    value = (top * (1 - fw) + bottom * fw) * depth / (0.5 * (intrinsics[v, 0] + intrinsics[v, 1]))
                    visible += 1
                    if value > largest[max_ranked - 1]:
                        slot = max_ranked - 1
                        while slot > 0 and largest[slot - 1] < value:
                            largest[slot] = largest[slot - 1]
                            slot -= 1
                        largest[slot] = value
                        if largest[max_inconsistent] > far:  # no later view can change the result
                            break
                if largest[max_inconsistent] > far:
                    out[i, j, k] = largest[max_inconsistent]
                elif visible < min_visible:
                    out[i, j, k] = cell
                else:
                    allowed = min(int(max_inconsistent_share * visible + 0.5), max_ranked - 1, visible - 1)
                    out[i, j, k] = largest[allowed]


def silhouette_distance(mask: Bytes) -> Floats:
    """Signed distance in pixels from the edge of a mask (h, w), positive outside; the frame's edge is no silhouette.

    Without an edge the distance is ± the image diagonal everywhere.
    """
    inside = (mask > 127).astype(np.uint8)
    if inside.all() or not inside.any():
        far = float(np.hypot(*mask.shape))
        return np.full(mask.shape, -far if inside.all() else far, np.float32)
    outer, inner = distance_to_zero(1 - inside), distance_to_zero(inside)
    # Distances are between pixel centres; the edge lies half a pixel before them.
    return np.where(inside > 0, 0.5 - inner, outer - 0.5).astype(np.float32)


def carve(
    cameras: Sequence[Camera], masks: Sequence[Bytes], centre: Array, radius: float, resolution: int,
    max_inconsistent_share: float = MAX_INCONSISTENT_SHARE, min_visible_share: float = MIN_VISIBLE_SHARE,
) -> Floats:  # fmt: skip
    """Signed distance (n, n, n) of the hull on the cube of half edge `radius` around `centre` (3,), negative inside; axes x, y, z.

    `cameras` are pinholes of the masks' sizes; n = `resolution`. Where less than `min_visible_share` of the views (or fewer than 2) see a
    cell, the value is one cell (outside).
    The occupancy is `carve(...) < 0`. `max_inconsistent_share` of a point's views may exclude it; above the default there is no bound on
    their number, which costs time in large captures.
    """
    fields = [silhouette_distance(m) for m in masks]
    sizes = np.array([f.shape for f in fields], np.int64).reshape(-1, 2)
    flat, starts = concatenate_images(fields)
    _, intrinsics, poses, _ = camera_arrays(cameras)
    # A low-discrepancy order of the views: empty cells are excluded after a few.
    order = np.argsort(np.arange(len(fields)) * 0.6180339887498949 % 1.0)
    cell = 2.0 * radius / resolution
    min_visible = max(2, int(np.ceil(min_visible_share * len(fields))))
    wide = max_inconsistent_share > MAX_INCONSISTENT_SHARE
    ranked = max(_MAX_RANKED, int(max_inconsistent_share * len(fields) + 0.5) + 1) if wide else _MAX_RANKED
    out = np.empty((resolution, resolution, resolution), np.float32)
    args = (
        flat, starts[order], sizes[order], intrinsics[order], poses[order], np.asarray(centre, float) - radius, cell,
        max_inconsistent_share, ranked, min_visible, out,
    )  # fmt: skip
    run_chunks(lambda lo, hi: _carve(lo, hi, *args), resolution)
    return out


def _large_components(inside: NDArray[np.bool_], share: float = 0.05) -> NDArray[np.bool_]:
    """Remove connected components smaller than `share` of the largest (where silhouettes intersect in empty space)."""
    from scipy import ndimage

    labels, count = ndimage.label(inside, structure=np.ones((3, 3, 3)))
    if count < 2:
        return inside
    volume = np.bincount(labels.ravel())
    volume[0] = 0
    return np.asarray((volume >= share * volume.max())[labels] & inside)


@dataclass(frozen=True)
class Hull:
    """Visual hull: `occupancy` (n, n, n) with axes x, y, z; cell (i, j, k) has its centre at `lower` + (i+.5, j+.5, k+.5)·`cell`.

    `field` (n, n, n) is the signed distance at the cell centres, negative inside.
    """

    occupancy: NDArray[np.bool_]
    lower: Array
    cell: float
    field: Floats

    @staticmethod
    def from_masks(
        cameras: Sequence[Camera], masks: Sequence[Bytes], centre: Array, radius: float, resolution: int,
        max_inconsistent_share: float = MAX_INCONSISTENT_SHARE, min_visible_share: float = MIN_VISIBLE_SHARE,
    ) -> Hull:  # fmt: skip
        """Carve the cube of half edge `radius` around `centre`; small components are removed."""
        field = carve(cameras, masks, centre, radius, resolution, max_inconsistent_share, min_visible_share)
        cell = 2.0 * radius / resolution
        inside = field < 0
        kept = _large_components(inside)
        field[inside & ~kept] = cell
        return Hull(kept, np.asarray(centre, float) - radius, cell, field)

    def save(self, path: Path) -> None:
        """Write as a NumPy archive, the distances in half precision."""
        largest = float(np.finfo(np.float16).max)
        np.savez_compressed(path, field=self.field.clip(-largest, largest).astype(np.float16), lower=self.lower, cell=self.cell)

    @staticmethod
    def load(path: Path) -> Hull:
        """Read what `save` wrote."""
        with np.load(path) as body:
            field = body["field"].astype(np.float32)
            return Hull(field < 0, body["lower"], float(body["cell"]), field)

    @property
    def empty(self) -> bool:
        """Whether no cell is left."""
        return not bool(self.occupancy.any())

    def centres(self) -> Array:
        """Centres (n, 3) of the occupied cells."""
        return np.asarray(self.lower + (np.argwhere(self.occupancy) + 0.5) * self.cell)

    def _sample(self, points: Array) -> Array:
        from scipy import ndimage

        index = (np.asarray(points, float) - self.lower) / self.cell - 0.5
        return np.asarray(ndimage.map_coordinates(self.field, index.reshape(-1, 3).T, order=1, mode="nearest"), float)

    def signed_distance(self, points: Array) -> Array:
        """Signed distance (k,) of points (k, 3), negative inside, trilinear between cells.

        A lower bound outside; beyond the grid the distance to the grid is added.
        """
        pts = np.asarray(points, float).reshape(-1, 3)
        upper = self.lower + self.cell * np.array(self.field.shape)
        beyond = np.linalg.norm(pts - np.clip(pts, self.lower, upper), axis=1)
        return np.asarray(self._sample(pts) + beyond)

    def cells_of(self, points: Array) -> tuple[NDArray[np.int64], ...]:
        """Indices, three of (k,), of the cells with the points (k, 3); of the nearest ones for points beyond the grid."""
        index = np.floor((points - self.lower) / self.cell).astype(np.int64)
        return tuple(np.clip(index, 0, np.array(self.field.shape) - 1).T)

    def gradient(self, points: Array) -> Array:
        """Outward unit normals (k, 3) of the field at points (k, 3), central differences over one cell."""
        pts = np.asarray(points, float).reshape(-1, 3)
        steps = np.eye(3) * self.cell
        out = np.stack([self._sample(pts + s) - self._sample(pts - s) for s in steps], 1)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return np.where(length > 1e-12, out / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])

    def triangles(self) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (v, 3) and outward faces (f, 3) of the surface by marching cubes. Raises ValueError for an empty hull."""
        if self.empty:
            raise ValueError("the visual hull is empty")
        from skimage.measure import marching_cubes

        solid = np.pad(np.clip(self.field, -4 * self.cell, 4 * self.cell), 1, constant_values=self.cell)  # closed at the grid's edge
        vertices, faces, _, _ = marching_cubes(solid, 0.0)
        return (vertices.astype(float) - 0.5) * self.cell + self.lower, faces.astype(np.int64)

    def surface_points(self, count: int, seed: int) -> tuple[Array, Array]:
        """`count` points (k, 3) spread evenly by area over the hull's surface, and outward unit normals (k, 3).

        Raises ValueError for an empty hull.
        """
        vertices, faces = self.triangles()
        corners = vertices[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        rng = np.random.default_rng(seed)
        # Stratified sampling along the cumulative area: more even than independent samples.
        total = np.cumsum(area)
        face = np.searchsorted(total, (np.arange(count) + rng.random(count)) / count * total[-1]).clip(0, len(area) - 1)
        a, b = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1 - a, a * (1 - b), a * b], 1)
        points = np.einsum("kc,kcd->kd", weights, corners[face])
        return points, self.gradient(points)


def read_masks(posed: PosedPhotos, max_size: int = 512) -> tuple[list[Camera], list[Bytes]]:
    """Masks (h, w) of a capture, the longer side at most `max_size` pixels, and their cameras. Raises ValueError when a photo has none."""
    cameras, masks = [], []
    for index in range(len(posed)):
        camera, mask = posed.mask(index, max_size)
        if mask is None:
            raise ValueError(f"photo {camera.name} has no mask")
        cameras.append(camera)
        masks.append(mask)
    return cameras, masks


def visual_hull(posed: PosedPhotos, resolution: int = 128, max_size: int = 512) -> Hull:
    """Visual hull of a masked capture in the unit frame, on the cube [-1, 1]³. Masks are read at `max_size`.

    Raises ValueError when a photo has no mask.
    """
    return unit_hull(*read_masks(posed, max_size), resolution)


def unit_hull(cameras: Sequence[Camera], masks: Sequence[Bytes], resolution: int = 128) -> Hull:
    """Visual hull of masks that are read, on the cube [-1, 1]³ of the unit frame; `cameras` are pinholes of the masks' sizes."""
    return Hull.from_masks(cameras, masks, np.zeros(3), 1.0, resolution)
