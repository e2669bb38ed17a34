"""Photometric measurement of mesh displacements along the normals, by every photo at a subset of the vertices.

A planar patch, mapped from one photo to others by the plane's homography, matches best at the true depth (Goesele et al., *Multi-view
stereo for community photo collections*, ICCV 2007). The plane passes through the mean of the mesh over the patch: a plane fitted to a
curved surface lies below its apex, by a quarter of a pixel at a radius of a hundred pixels.

A measurement is weighted by its Fisher information: a summed cost with second derivative b and residual c per view gives s b / (2 c) with
s samples. It is used only where stereo confirmed the photo's depth, times that confidence, and by majority: most of the photos that see a
vertex must give a valid measurement. Specular reflections differ between photos: stereo confirms few of them and fewer are consistent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.kernels.threads import run_chunks
from gsbake.meshing.cleanup import Vertices
from gsbake.meshing.refinement.photometric_kernel import measure_displacements
from gsbake.mvs.ncc import RADIUS, SAMPLES, SamplingPattern
from gsbake.mvs.pyramids import MatchingViews, Photo
from gsbake.mvs.view_selection import select_views
from gsbake.shape_refinement.surface import Surface, surface_area
from gsbake.shape_refinement.targets import Targets, vertex_rows

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Photos with which each photo is compared, and how many of them, the best at each point, are used.
NEIGHBOURS, BEST_VIEWS = 6, 4
#: Points from which the photos' shared visibility is determined.
PAIRING_POINTS = 500
#: Minimum cosine between normal and viewing direction of a measurement.
MIN_COSINE = 0.4
#: Step along the normal in pixels of the reference photo: a quarter of a pixel of disparity at 14 degrees between photos.
STEP_PIXELS = 1.0
#: Maximum distance in steps of a parabola's minimum, and of the patch plane from the surface.
MAX_STEPS = 1.5
#: Square pixels of surface per measured vertex; a patch covers ten times as many.
PIXELS_PER_POINT = 24.0
#: Weighted mean squared distance of a patch's samples from its centre in square pixels; maximum random-walk steps.
PATCH_VARIANCE, MAX_WALK_STEPS = 36.0, 200
#: Residual in pixels beyond which a patch counts linearly: typical error of an inlier.
OUTLIER = 0.6
#: Minimum residual cost (aliasing, compression).
NOISE_FLOOR = 0.02
#: Maximum information per square pixel of one measurement.
MAX_INFORMATION = 3.0


@dataclass(frozen=True)
class PhotometricViews:
    """Photos for photometric refinement: `cameras`, `photo(i)` at the same size, and `depth(i)`: stereo z-depth (h, w; 0 = none) and
    confidence at any size of photo i, or None. A stereo depth within `tolerance` (world units) of the mesh confirms it."""

    cameras: Sequence[Camera]
    photo: Callable[[int], Photo]
    depth: Callable[[int], tuple[Floats, Floats] | None]
    tolerance: float


@dataclass(frozen=True)
class MeasurementPlan:
    """Constants of the refinement of one mesh: its `surface`, indices of the `measured_vertices`, median `pixel_size` on the surface,
    the photos paired with each photo, and `patch_share`, one vertex's share of a patch's area."""

    surface: Surface
    measured_vertices: Indices
    pixel_size: float
    pairs: list[list[int]]
    patch_share: float

    @staticmethod
    def make(surface: Surface, vertices: Vertices, cameras: Sequence[Camera]) -> MeasurementPlan:
        """Plan for a mesh (unit frame, outward winding) and its cameras."""
        area, count = surface_area(vertices, surface.faces), len(vertices)
        pixel_size = float(np.median([np.linalg.norm(c.centre - vertices.mean(0)) / (0.5 * (c.fx + c.fy)) for c in cameras]))
        vertex_area = area / count / pixel_size**2
        sample = np.arange(0, count, max(1, count // PAIRING_POINTS))
        pairs, _ = select_views(cameras, vertices[sample], surface.normals(vertices)[sample], NEIGHBOURS, NEIGHBOURS)
        measured_vertices = np.arange(0, count, max(1, round(PIXELS_PER_POINT / vertex_area)))
        return MeasurementPlan(surface, measured_vertices, pixel_size, pairs, min(vertex_area / (np.pi * RADIUS**2), 1.0))


@dataclass(frozen=True)
class Measurements:
    """Measurements (m,), one per photo that sees a `vertex`: `displacement` along the normal in world units;
    `information` per square pixel, 0 when invalid."""

    vertex: Indices
    displacement: Doubles
    information: Doubles

    def weights(self) -> Doubles:
        """Information (m,) times the majority at its vertex: the share of valid measurements minus that of invalid ones, or 0."""
        visible = np.bincount(self.vertex)
        useful = np.bincount(self.vertex, self.information > 0)
        return self.information * np.maximum(2 * useful / np.maximum(visible, 1) - 1, 0)[self.vertex]


class PatchTargets:
    """Measures patches at the vertices of a surface, for `refine_shape`; what does not change with the vertices is determined once."""

    def __init__(self, views: PhotometricViews, threads: int) -> None:
        self._views, self._threads = views, threads
        self._plan: MeasurementPlan | None = None

    def __call__(self, surface: Surface, vertices: Vertices) -> tuple[Targets, float]:
        """Targets at the measured vertices, and the share of them at which most photos agree."""
        if surface_area(vertices, surface.faces) == 0:
            return Targets.none(surface.count), 0.0
        self._plan = plan = self._plan or MeasurementPlan.make(surface, vertices, self._views.cameras)
        found = measure(vertices, plan, self._views, self._threads)
        # Patches overlap: a measurement is weighted by the share of a patch that is not shared with others.
        stride = -(-len(vertices) // len(plan.measured_vertices))
        weight = found.weights() * min(stride * plan.patch_share, 1.0)
        used = weight > 0
        rows = vertex_rows(found.vertex[used], len(vertices))
        outlier = np.full(int(used.sum()), OUTLIER * plan.pixel_size)
        targets = Targets(rows, found.displacement[used], weight[used] / plan.pixel_size**2, outlier)
        return targets, len(np.unique(found.vertex[used])) / len(plan.measured_vertices)


def patch_means(vertices: Vertices, surface: Surface, mean_squared_distance: float) -> Vertices:
    """Mean (v, 3) of the surface around each vertex, weighted with variance `mean_squared_distance` (world units²).

    A random walk from a vertex to one of its n neighbours or itself with equal probability adds n / (n + 1) of the mean squared edge
    per step.
    """
    edges, transition = surface.edges, surface.adjacency + sparse.identity(surface.count)
    row_sums = np.asarray(transition.sum(1)).ravel()
    transition = sparse.diags(1 / row_sums) @ transition
    variance_per_step = float(((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1).mean() * (1 - 1 / row_sums.mean()))
    for _ in range(min(round(mean_squared_distance / variance_per_step), MAX_WALK_STEPS)):
        vertices = transition @ vertices
    return vertices


def measure(vertices: Vertices, plan: MeasurementPlan, views: PhotometricViews, threads: int) -> Measurements:
    """Measurements of every photo, with its paired photos, at the measured vertices."""
    surface, measured_vertices = plan.surface, plan.measured_vertices
    caster = RayCaster(vertices, surface.faces, threads)
    means = patch_means(vertices, surface, PATCH_VARIANCE * plan.pixel_size**2)
    points, normals = vertices[measured_vertices], surface.normals(means)[measured_vertices]
    plane_offset = np.einsum("nk,nk->n", normals, means[measured_vertices] - points)
    ray_offset = 0.5 * surface.mean_edge(vertices)
    visible = np.stack([caster.visible_from(camera, points, normals, MIN_COSINE, ray_offset) for camera in views.cameras])
    parts = [_measure_photo(index, others, visible, (points, normals, plane_offset), views) for index, others in enumerate(plan.pairs)]
    rows, displacement, information = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Measurements(measured_vertices[rows], displacement, information)


def _measure_photo(
    index: int, others: list[int], visible: NDArray[np.bool_], surface: tuple[Vertices, Vertices, Doubles], views: PhotometricViews
) -> tuple[Indices, Doubles, Doubles]:
    """Rows of the points visible in photo `index` and one of the `others`, with displacement and information.

    `surface` is points and normals (n, 3), and the offset (n,) along the normal of the mesh's mean over a patch at normal incidence.
    """
    camera = views.cameras[index]
    rows = np.flatnonzero(visible[index] & visible[others].any(0))
    if len(rows) == 0:
        return rows, np.zeros(0), np.zeros(0)
    points, normals, plane_offset = (part[rows] for part in surface)
    to_camera = camera.centre - points
    cosine = np.einsum("nk,nk->n", normals, to_camera) / np.linalg.norm(to_camera, axis=1)
    oblique_offset = 0.5 * (1 + 1 / cosine**2) * plane_offset  # at oblique incidence the patch is elongated in one direction
    local = (points + oblique_offset[:, None] * normals) @ camera.R.T + camera.t
    pixel_size = local[:, 2] / (0.5 * (camera.fx + camera.fy))
    steps = (STEP_PIXELS * pixel_size).astype(np.float32)
    visible_bits = (visible[others][:, rows].astype(np.int64) << np.arange(len(others))[:, None]).sum(0)
    pair = MatchingViews.of(views.photo(index), [views.photo(j) for j in others])
    pattern = SamplingPattern.make()
    displacement, curvature, cost = (np.empty(len(rows), np.float32) for _ in range(3))
    fixed = (
        local.astype(np.float32), (normals @ camera.R.T).astype(np.float32), visible_bits, steps, pair.grey, pair.inside, pair.intrinsics,
        pattern.arrays, pair.sources, BEST_VIEWS,
        displacement, curvature, cost,
    )  # fmt: skip
    run_chunks(lambda start, stop: measure_displacements(start, stop, *fixed), len(rows), minimum=256)
    information = np.minimum(SAMPLES / 2 * curvature / STEP_PIXELS**2 / (cost + NOISE_FLOOR), MAX_INFORMATION)
    valid = (np.abs(displacement) <= MAX_STEPS * steps) & (np.abs(oblique_offset) <= MAX_STEPS * steps)
    weight = _confidence(camera, points, views.depth(index), views.tolerance)
    return rows, displacement.astype(np.float64), np.where(valid, information, 0.0) * weight


def _confidence(camera: Camera, points: Vertices, stereo: tuple[Floats, Floats] | None, tolerance: float) -> Doubles:
    """Stereo confidence (n,) at points (n, 3) inside the image whose stereo depth lies within `tolerance`; else 0."""
    if stereo is None:
        return np.zeros(len(points))
    depth, confidence = stereo
    uv, z = camera.project(points)
    size = np.array(depth.shape[::-1])
    column, row = np.minimum((uv * (size / (camera.width, camera.height))).astype(np.int64), size - 1).T
    stereo_depth = depth[row, column]
    return np.where((stereo_depth > 0) & (np.abs(stereo_depth - z) <= tolerance), confidence[row, column], 0).astype(np.float64)
