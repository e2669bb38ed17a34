"""UV atlas: charts by xatlas, packed by `gsbake.texturing.packing` into an exact power-of-two square.

xatlas' chart growing is superlinear in the number of faces, so the mesh is split into compact clusters first, which run as separate meshes
in parallel. Mirrored charts are mirrored back, and every chart is scaled to its true surface area for a uniform texel density.

UVs are in the glTF convention: origin at the top left of the image, v downwards. Seen from outside, the image is never mirrored:
with v flipped upwards every triangle keeps its counter-clockwise orientation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import xatlas
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from gsbake.texturing.packing import pack
from gsbake.texturing.texels import overlapping_faces

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Faces per cluster handed to xatlas. 30 000 faces, one core: 7.9 s as one mesh, 2.4 s in clusters of a thousand, with fewer charts.
CLUSTER_FACES = 1000
#: Most faces clustered at once: the time of k-means grows with its square. Larger meshes are halved along their longest side first.
KMEANS_FACES = 1 << 16
#: Largest share of the texture that padding takes; more charts than that allows get less padding than they ask for, at least MIN_PADDING.
PADDING_SHARE, MIN_PADDING = 0.25, 2
#: Above this mean dihedral angle (radians) a surface counts as noisy and is smoothed, for charting only.
NOISY_DIHEDRAL = 0.2
#: Laplacian steps of that smoothing.
SMOOTHING_STEPS = 4
#: Diagonal of the mesh that is charted, to within a factor of √2: about that of the unit frame. xatlas' thresholds are absolute.
DIAGONAL = 2.0
#: Advice for a mesh that cannot be unwrapped.
_REPLACE = "run the mesh stage again or replace the mesh"
#: Resolution at which charts that overlap themselves are searched for.
CHECK_SIZE = 2048


@dataclass(frozen=True)
class Atlas:
    """Result of `make_atlas`.

    `source` (v',) input vertex of each atlas vertex, `uv` (v', 2) float32 in 0..1 (glTF: origin top left), `faces` (f, 3) int32 in atlas
    vertices, in input order; `chart` (f,) int32; `size` edge of the texture in texels; `fill` share of it under charts.
    """

    source: NDArray[np.int32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    chart: NDArray[np.int32]
    size: int
    fill: float

    @property
    def charts(self) -> int:
        """Number of charts."""
        return int(self.chart.max()) + 1 if len(self.chart) else 0


def signed_areas(uv: NDArray[Any], faces: NDArray[Any]) -> Floats:
    """Signed areas (f,) of triangles `faces` (f, 3) in the plane of `uv` (v, 2); positive when oriented from +u to +v."""
    a, b, c = (np.asarray(uv, np.float64)[faces[:, k]] for k in range(3))
    return 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]))


def make_atlas(vertices: NDArray[Any], faces: NDArray[Any], size: int, padding: int | None = None) -> Atlas:
    """Unwrap a mesh: `vertices` (v, 3) in any unit, `faces` (f, 3), onto a texture of `size` texels.

    `padding` texels are left between charts (default: size / 128), fewer where so many charts would be mostly padding. Raises ValueError
    when the mesh has no area or its charts cannot fit.
    """
    triangles = np.asarray(faces, np.int64)
    points = _normalised(np.asarray(vertices, np.float64), triangles)
    wanted = max(MIN_PADDING, size // 128) if padding is None else padding
    source, uv, corner = _chart(_smoothed_when_noisy(points, triangles), triangles)
    chart = islands(len(uv), corner)
    uv = _normalise_charts(points, triangles, uv, corner, chart)
    if not np.abs(signed_areas(uv, corner)).sum() > 0:
        raise ValueError(f"the triangles of the mesh are too thin to unwrap; {_REPLACE}")
    packed = pack(uv, corner, chart, size, _padding(chart, size, wanted))
    for alone in (False, True, True):
        folded = overlapping_faces(packed.uv / size, corner, CHECK_SIZE)
        if not folded.any():
            break
        source, uv, corner = _detach(source, uv, corner, folded, alone)
        chart = islands(len(uv), corner)
        packed = pack(uv, corner, chart, size, _padding(chart, size, wanted))
    final = packed.uv / size
    fill = float(np.abs(signed_areas(final, corner)).sum())
    final[:, 1] = 1 - final[:, 1]
    coordinates = np.clip(final, 0, 1).astype(np.float32)
    return Atlas(source.astype(np.int32), coordinates, corner.astype(np.int32), chart.astype(np.int32), size, fill)


def _normalised(points: Floats, faces: Ints) -> Floats:
    """The vertices scaled by a power of two to about `DIAGONAL`, about the origin where they are far from it."""
    if len(faces) == 0 or not np.isfinite(points).all():
        raise ValueError(f"a mesh without faces or with positions that are not finite has no atlas; {_REPLACE}")
    used = points[np.unique(faces)]
    lower, upper = used.min(0), used.max(0)
    diagonal, centre = float(np.linalg.norm(upper - lower)), (lower + upper) / 2
    if not diagonal > 0:
        raise ValueError(f"a mesh without area has no atlas; {_REPLACE}")
    if np.linalg.norm(centre) > diagonal:
        points = points - centre
    return np.asarray(points * 2.0 ** np.round(np.log2(DIAGONAL) - np.log2(diagonal)))


def _padding(chart: Ints, size: int, wanted: int) -> int:
    """Texels between charts: the `wanted` ones, fewer where they would take more than `PADDING_SHARE` of the texture."""
    return min(wanted, max(MIN_PADDING, int(np.sqrt(PADDING_SHARE / (int(chart.max()) + 1)) * size)))


def islands(count: int, corner: Ints) -> Ints:
    """Chart (f,) of each face: faces that share a vertex of the atlas belong together."""
    links = coo_matrix((np.ones(2 * len(corner)), (corner[:, [0, 1]].ravel(), corner[:, [1, 2]].ravel())), shape=(count, count))
    label = connected_components(links, directed=False)[1][corner[:, 0]]
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64)


def _detach(source: Ints, uv: Floats, corner: Ints, folded: NDArray[np.bool_], alone: bool) -> tuple[Ints, Floats, Ints]:
    """Make charts of the folded faces (f,), with vertices of their own: one per connected group, or one per face if `alone`."""
    index = np.flatnonzero(folded)
    group = np.arange(len(index)) if alone else islands(len(uv), corner[index])
    pairs = np.stack([np.repeat(group, 3), corner[index].ravel()], 1)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    out = corner.copy()
    out[index] = len(uv) + inverse.reshape(-1, 3)
    used, compact = np.unique(out, return_inverse=True)
    from_old = np.concatenate([np.arange(len(uv)), unique[:, 1]])[used]
    return source[from_old], uv[from_old], compact.reshape(-1, 3)


def _chart(points: Floats, faces: Ints) -> tuple[Ints, Floats, Ints]:
    """Charts of all clusters: source vertex (v',), uv (v', 2) in one unit per cluster, faces (f, 3) in input order."""
    label = _clusters(points[faces].mean(1))
    atlas = xatlas.Atlas()
    parts: list[tuple[Ints, Ints]] = []
    for k in range(label.max() + 1):
        mine = np.flatnonzero(label == k)
        if len(mine) == 0:
            continue
        used, inverse = np.unique(faces[mine], return_inverse=True)
        atlas.add_mesh(points[used].astype(np.float32), inverse.reshape(-1, 3).astype(np.uint32))
        parts.append((mine, used))
    options = xatlas.PackOptions()
    options.rotate_charts = options.rotate_charts_to_axis = False
    options.resolution = 1024  # arbitrary: charts are packed again
    options.blockAlign = True
    atlas.generate(xatlas.ChartOptions(), options)
    source, coordinates, corner = [], [], np.zeros_like(faces)
    count = 0
    for i, (mine, used) in enumerate(parts):
        mapping, index, uv = atlas.get_mesh(i)
        corner[mine] = index.reshape(-1, 3).astype(np.int64) + count
        source.append(used[mapping])
        coordinates.append(uv.astype(np.float64) * [max(atlas.width, 1), max(atlas.height, 1)])
        count += len(mapping)
    return np.concatenate(source), np.concatenate(coordinates), corner


def _clusters(centres: Floats) -> Ints:
    """Compact cluster of each face (f,), about `CLUSTER_FACES` faces each."""
    if len(centres) > KMEANS_FACES:
        axis = int(np.ptp(centres, axis=0).argmax())
        order = np.argsort(centres[:, axis], kind="stable")
        label, count = np.empty(len(centres), np.int64), 0
        for half in np.array_split(order, 2):
            label[half] = count + _clusters(centres[half])
            count = int(label[half].max()) + 1
        return label
    count = round(len(centres) / CLUSTER_FACES)
    if count < 2:
        return np.zeros(len(centres), np.int64)
    return np.asarray(kmeans2(centres, count, iter=8, minit="++", rng=np.random.default_rng(0), missing="warn")[1], np.int64)


def _normalise_charts(points: Floats, faces: Ints, uv: Floats, corner: Ints, chart: Ints) -> Floats:
    """Charts without mirroring, in surface units, each rotated so that its tightest bounding box is axis-aligned."""
    count = int(chart.max()) + 1
    area_uv = np.bincount(chart, signed_areas(uv, corner), count)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.bincount(chart, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1), count)
    owner = np.zeros(len(uv), np.int64)
    owner[corner] = chart[:, None]
    factor = np.where(np.abs(area_uv) > 0, np.sqrt(area / np.maximum(np.abs(area_uv), 1e-30)), 0.0)
    out = uv * factor[owner][:, None]
    out[:, 0] *= np.where(area_uv < 0, -1.0, 1.0)[owner]
    order = np.argsort(owner, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(owner[order])) + 1):
        (_, _, angle) = cv2.minAreaRect(out[part].astype(np.float32))
        turn = np.radians(angle)
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        out[part] = out[part] @ rotation.T
    return out


def _smoothed_when_noisy(points: Floats, faces: Ints) -> Floats:
    """The positions used for charting: Laplacian-smoothed if the surface is noisy, else unchanged."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face_of = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face_of = edges[order], face_of[order]
    same = np.flatnonzero((edges[1:] == edges[:-1]).all(1))
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    cosine = np.einsum("nd,nd->n", normal[face_of[same]], normal[face_of[same + 1]])
    if len(same) == 0 or np.arccos(np.clip(cosine, -1, 1)).mean() < NOISY_DIHEDRAL:
        return points
    n = len(points)
    links = coo_matrix((np.ones(2 * len(edges)), (edges.ravel(), edges[:, ::-1].ravel())), shape=(n, n)).tocsr()
    links.data[:] = 1.0
    degree = np.maximum(np.asarray(links.sum(1)).ravel(), 1)
    out = points
    for _ in range(SMOOTHING_STEPS):
        out = 0.5 * out + 0.5 * (links @ out) / degree[:, None]
    return np.where(degree[:, None] > 1, out, points)
