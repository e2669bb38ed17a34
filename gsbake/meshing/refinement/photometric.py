"""Photometric mesh refinement: moves vertices along their normals to maximise photometric consistency on textured surfaces.

Mask boundaries are biased and surfels extend beyond their centres: these errors are equal in all views and do not average out. Measurements
on texture (`photometric_measure`) are interpolated over the mesh by a screened least-squares system, so that specular and untextured
regions follow their textured neighbours or are unchanged; Geman-McClure weights remove outliers. Mesh refinement after Vu et al., *High
accuracy and visibility-consistent dense multiview stereo*, PAMI 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from gsbake.meshing.cleanup import Faces, Vertices
from gsbake.meshing.refinement.laplacian import solve_screened_laplacian
from gsbake.meshing.refinement.normals import vertex_normals
from gsbake.meshing.refinement.photometric_measure import Doubles, MeasurementPlan, Measurements, PhotometricViews, measure, surface_area

#: Information (per square pixel) of the smoothness term per edge, and of the zero prior per area of a patch.
SMOOTHNESS_WEIGHT, ZERO_WEIGHT = 0.4, 0.03
#: Scale of the Geman-McClure weight in pixels: typical error of an inlier.
ROBUST_SCALE = 0.6
#: Solutions of iteratively reweighted least squares.
REWEIGHTING_STEPS = 3
#: Maximum displacement per round in pixels.
MAX_DISPLACEMENT = 2.0
#: Minimum median displacement of a round in pixels; refinement ends below it.
MIN_DISPLACEMENT = 0.1


@dataclass(frozen=True)
class PhotometricResult:
    """The refined `vertices` (v, 3); `consistent_share` of the measured vertices with a majority of valid measurements, their
    `median_displacement` in pixels (summed over rounds), their median NCC before and after; `rounds` made, 0 = unchanged."""

    vertices: Vertices
    consistent_share: float
    median_displacement: float
    ncc_before: float
    ncc_after: float
    rounds: int


def solve_displacements(measurements: Measurements, plan: MeasurementPlan, count: int) -> Doubles:
    """Displacements (count,) in world units that interpolate the measurements smoothly."""
    # Patches overlap: a measurement is weighted by the share of a patch that is not shared with others.
    stride = -(-count // len(plan.measured_vertices))
    weight, target = measurements.weights() * min(stride * plan.patch_share, 1.0), measurements.displacement / plan.pixel_size
    displacement = np.zeros(count)
    for step in range(REWEIGHTING_STEPS):
        residual = (target - displacement[measurements.vertex]) / ROBUST_SCALE
        robust_weight = weight / (1 + residual**2) ** 2 if step else weight
        data = sparse.diags(np.bincount(measurements.vertex, robust_weight, count) + ZERO_WEIGHT * plan.patch_share)
        right_side = np.asarray(np.bincount(measurements.vertex, robust_weight * target, count), np.float64)
        displacement = solve_screened_laplacian(data, right_side, plan.edges, SMOOTHNESS_WEIGHT)
    return np.clip(displacement, -MAX_DISPLACEMENT, MAX_DISPLACEMENT) * plan.pixel_size


def improves(before: Measurements, after: Measurements) -> bool:
    """Whether the median NCC change of the measurements `before` with positive weight is positive.

    The mean is unsuitable: few patches that slip off the surface or behind an edge lose a hundred times what the others gain.
    """
    rows_before, rows_after = before.shared(after)
    return len(rows_before) > 0 and float(np.median(after.ncc[rows_after] - before.ncc[rows_before])) > 0


def refine_photometric(vertices: Vertices, faces: Faces, views: PhotometricViews, rounds: int, threads: int) -> PhotometricResult:
    """Refine the `vertices` (v, 3) of a mesh (unit frame, outward winding) by photometric consistency.

    A round that does not increase the NCC of most measurements is discarded and ends the refinement.
    """
    if surface_area(vertices, faces) == 0:
        return PhotometricResult(vertices, 0.0, 0.0, 0.0, 0.0, 0)
    plan = MeasurementPlan.make(vertices, faces, views.cameras)
    initial = measurements = measure(vertices, plan, views, threads)
    displacements: list[float] = []
    while len(displacements) < rounds:
        used = np.unique(measurements.vertex[measurements.weights() > 0])
        if len(used) == 0:
            break
        displacement = solve_displacements(measurements, plan, len(vertices))
        median_displacement = float(np.median(np.abs(displacement[used]))) / plan.pixel_size
        if median_displacement < MIN_DISPLACEMENT:
            break
        moved = vertices + vertex_normals(vertices, faces) * displacement[:, None]
        candidate = measure(moved, plan, views, threads)
        if not improves(measurements, candidate):
            break
        vertices, measurements = moved, candidate
        displacements.append(median_displacement)
    rows_before, rows_after = initial.shared(measurements)
    before, after = (float(np.median(ncc)) if len(rows_before) else 0.0 for ncc in (initial.ncc[rows_before], measurements.ncc[rows_after]))
    share = len(np.unique(initial.vertex[rows_before])) / len(plan.measured_vertices)
    return PhotometricResult(vertices, share, sum(displacements), before, after, len(displacements))
