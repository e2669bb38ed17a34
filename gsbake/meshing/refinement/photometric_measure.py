"""What photos say about where a mesh should be: displacements along its normals, measured by every photo at points spread over it.

A patch in a plane, carried from one photo to others by the plane's homography, matches best where the surface is (Goesele et al.,
*Multi-view stereo for community photo collections*, ICCV 2007). The plane lies through the mean of the mesh over the patch: a plane that
fits a bent surface lies under its crest, by a quarter of a pixel where the radius is a hundred.

A measurement is worth its Fisher information: a summed cost with second derivative b, left at c per view by noise, says s b / (2 c) with s
samples. It counts only where stereo confirmed the photo's depth, times that confidence, and by majority: of the photos that see a
place, most must say something useful. Gloss shows every photo another reflection: stereo confirms few of them and fewer agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.meshing.cleanup import Faces, Vertices
from gsbake.meshing.refinement.normals import edges_of, vertex_normals
from gsbake.meshing.refinement.photometric_kernel import displace
from gsbake.mvs.ncc import RADIUS, SAMPLES, Pattern
from gsbake.mvs.pyramids import Pair, Photo
from gsbake.mvs.view_selection import choose
from gsbake.surfels.raster.threads import run_chunks

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Photos each photo is compared with, and how many of them, the best at each point, count.
NEIGHBOURS, BEST = 6, 4
#: Points that tell which photos look at the same places.
PAIRING = 500
#: A photo that sees a point under a smaller cosine does not measure it.
LEAST_COSINE = 0.4
#: Step along the normal to either side, in pixels of the reference: with 14 degrees between photos a quarter of a pixel of disparity.
STEP = 1.0
#: The lowest place of a parabola is believed up to this many steps away, and so is a plane on a surface that bends away from it.
BELIEVED = 1.5
#: One point is measured per this many square pixels of surface: a patch covers ten times as many.
SPARSE = 24.0
#: Mean squared distance of a patch's samples from its middle, by their weights, in square pixels; and most steps that are walked for it.
PATCH, MOST_STEPS = 36.0, 200
#: Relative variance of grey that no fit takes away (aliasing, compression).
FLOOR = 0.02
#: Most information per square pixel that one measurement is believed to hold.
MOST = 3.0


@dataclass(frozen=True)
class Capture:
    """The photos: their `cameras`, `photo(i)` at the same size, and `depth(i)`: z-depth (h, w; 0 = none) with confidence from stereo at any
    size of photo i, or None. A depth up to `tolerance` (world units) from the mesh speaks for it."""

    cameras: Sequence[Camera]
    photo: Callable[[int], Photo]
    depth: Callable[[int], tuple[Floats, Floats] | None]
    tolerance: float


@dataclass(frozen=True)
class Plan:
    """What stays while a mesh is moved: its `faces` and `edges`, the measured vertices `chosen`, the median size of a `pixel` on
    it, the photos each photo is paired with, and `share`, how much of a patch's area one vertex has."""

    faces: Faces
    edges: Indices
    chosen: Indices
    pixel: float
    pairs: list[list[int]]
    share: float

    @staticmethod
    def make(vertices: Vertices, faces: Faces, cameras: Sequence[Camera]) -> Plan:
        """For a mesh (unit frame, wound outward) that these cameras see."""
        corners, count = vertices[faces], len(vertices)
        area = 0.5 * float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())
        pixel = float(np.median([np.linalg.norm(c.centre - vertices.mean(0)) / (0.5 * (c.fx + c.fy)) for c in cameras]))
        own = area / count / pixel**2
        some = np.arange(0, count, max(1, count // PAIRING))
        pairs, _ = choose(cameras, vertices[some], vertex_normals(vertices, faces)[some], NEIGHBOURS, NEIGHBOURS)
        chosen = np.arange(0, count, max(1, round(SPARSE / own)))
        return Plan(faces, edges_of(faces), chosen, pixel, pairs, min(own / (np.pi * RADIUS**2), 1.0))


@dataclass(frozen=True)
class Samples:
    """Measurements, one per photo and vertex that it sees (m,): `photo` and `vertex`; `shift` along the normal in world units;
    `information` per square pixel, 0 when useless; mean `ncc` of the photos that match."""

    photo: Indices
    vertex: Indices
    shift: Doubles
    information: Doubles
    ncc: Doubles

    def weights(self) -> Doubles:
        """Information (m,) times the majority at its vertex: the share of useful measurements less that of useless ones, or 0."""
        seen = np.bincount(self.vertex)
        useful = np.bincount(self.vertex, self.information > 0)
        return self.information * np.maximum(2 * useful / np.maximum(seen, 1) - 1, 0)[self.vertex]

    def shared(self, later: Samples) -> tuple[Indices, Indices]:
        """Rows of the measurements with a weight, and rows of the `later` ones by the same photos at the same vertices."""
        rows = np.flatnonzero(self.weights() > 0)
        keys = [s.vertex << 32 | s.photo for s in (self, later)]
        _, mine, theirs = np.intersect1d(keys[0][rows], keys[1], assume_unique=True, return_indices=True)
        return rows[mine], theirs


def patch_means(vertices: Vertices, edges: Indices, spread: float) -> Vertices:
    """Means (v, 3) of the surface around each vertex, over places whose mean squared distance from it is `spread` (world units²).

    A walk from a vertex to one of its n neighbours or to itself, with equal chances, goes n / (n + 1) of a mean squared edge a step.
    """
    count = len(vertices)
    link = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    walk = link + link.T + sparse.identity(count)
    ways = np.asarray(walk.sum(1)).ravel()
    walk = sparse.diags(1 / ways) @ walk
    squared = float(((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1).mean() * (1 - 1 / ways.mean()))
    for _ in range(min(round(spread / squared), MOST_STEPS)):
        vertices = walk @ vertices
    return vertices


def measure(vertices: Vertices, plan: Plan, capture: Capture, threads: int) -> Samples:
    """What every photo with its pairs says about the chosen vertices."""
    edges, chosen = plan.edges, plan.chosen
    caster = RayCaster(vertices, plan.faces, threads)
    means = patch_means(vertices, edges, PATCH * plan.pixel**2)
    points, normals = vertices[chosen], vertex_normals(means, plan.faces)[chosen]
    sag = np.einsum("nk,nk->n", normals, means[chosen] - points)
    lift = 0.5 * float(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean())
    seen = np.stack([caster.seen_from(camera, points, normals, LEAST_COSINE, lift) for camera in capture.cameras])
    parts = [_of_photo(index, others, seen, (points, normals, sag), capture) for index, others in enumerate(plan.pairs)]
    photo = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    rows, shift, information, ncc = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Samples(photo, chosen[rows], shift, information, ncc)


def _of_photo(
    index: int, others: list[int], seen: NDArray[np.bool_], places: tuple[Vertices, Vertices, Doubles], capture: Capture
) -> tuple[Indices, Doubles, Doubles, Doubles]:
    """Rows of the points that photo `index` and one of the `others` see, with shift, information and NCC.

    `places` are points and normals (n, 3), and how far (n,) the mesh's mean over a patch seen head on lies above the point.
    """
    camera = capture.cameras[index]
    rows = np.flatnonzero(seen[index] & seen[others].any(0))
    if len(rows) == 0:
        return rows, np.zeros(0), np.zeros(0), np.zeros(0)
    points, normals, sag = (part[rows] for part in places)
    way = camera.centre - points
    cosine = np.einsum("nk,nk->n", normals, way) / np.linalg.norm(way, axis=1)
    bent = 0.5 * (1 + 1 / cosine**2) * sag  # seen obliquely a patch is longer in one of two directions
    local = (points + bent[:, None] * normals) @ camera.R.T + camera.t
    pixel = local[:, 2] / (0.5 * (camera.fx + camera.fy))
    steps = (STEP * pixel).astype(np.float32)
    sees = (seen[others][:, rows].astype(np.int64) << np.arange(len(others))[:, None]).sum(0)
    pair = Pair.of(capture.photo(index), [capture.photo(j) for j in others])
    pattern = Pattern.make()
    shift, bend, cost = (np.empty(len(rows), np.float32) for _ in range(3))
    fixed = (
        local.astype(np.float32), (normals @ camera.R.T).astype(np.float32), sees, steps, pair.grey, pair.inside, pair.lens,
        (pattern.du, pattern.dv, pattern.near, pattern.alike), (pair.lenses, pair.packed, pair.starts, pair.sizes), BEST,
        shift, bend, cost,
    )  # fmt: skip
    run_chunks(lambda start, stop: displace(start, stop, *fixed), len(rows), minimum=256)
    information = np.minimum(SAMPLES / 2 * bend / STEP**2 / (cost + FLOOR), MOST)
    believed = (np.abs(shift) <= BELIEVED * steps) & (np.abs(bent) <= BELIEVED * steps)
    sure = _confidence(camera, points, capture.depth(index), capture.tolerance)
    return rows, shift.astype(np.float64), np.where(believed, information, 0.0) * sure, 1.0 - cost.astype(np.float64)


def _confidence(camera: Camera, points: Vertices, measured: tuple[Floats, Floats] | None, tolerance: float) -> Doubles:
    """Stereo's confidence (n,) where its depth lies within `tolerance` of the points (n, 3), which are in the picture; else 0."""
    if measured is None:
        return np.zeros(len(points))
    depth, confidence = measured
    uv, z = camera.project(points)
    size = np.array(depth.shape[::-1])
    column, row = np.minimum((uv * (size / (camera.width, camera.height))).astype(np.int64), size - 1).T
    there = depth[row, column]
    return np.where((there > 0) & (np.abs(there - z) <= tolerance), confidence[row, column], 0).astype(np.float64)
