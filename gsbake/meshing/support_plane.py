"""Detection of the support plane (a table or a wall) from surfels or points, for captures without masks.

RANSAC (Fischler & Bolles, *Random sample consensus*, CACM 1981) over oriented samples, refined by weighted least squares. A plane is a
support plane when it extends to the boundary of the unit ball in most directions, the cameras are in front of it, and an object stands on
its centre. A lid or a wall of the object itself does not extend to the boundary.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.meshing.cleanup import component_areas, face_components, remove_unused_vertices

Floats = NDArray[np.float64]

#: Maximum distance (unit frame) from the plane and minimum cosine (25 degrees) between normals of inliers.
MAX_DISTANCE, MIN_COSINE = 0.02, 0.906
#: Candidate planes, each from one sample and its normal; samples on which inliers are counted.
RANSAC_TRIALS, RANSAC_SAMPLES = 400, 20_000
#: Sectors of the plane's disc in the ball, the share of the disc's radius that the plane must reach, and in how many sectors: untextured
#: planes have few surfels.
SECTORS, BORDER_RADIUS, MIN_SECTORS = 12, 0.75, 7
#: Minimum shares of the samples' weight that are inliers, and that stand on the plane near its centre.
MIN_PLANE_SHARE, MIN_OBJECT_SHARE = 0.1, 0.03
#: Minimum share of the cameras in front of the plane.
MIN_CAMERA_SHARE = 0.9
#: Quantile of the inliers' distances at which the mesh is cut, and maximum height of the cut above the plane.
CUT_QUANTILE, MAX_CUT = 0.98, 0.03


@dataclass(frozen=True)
class SupportPlane:
    """The plane `normal` · x = `offset` (unit frame, the object in front of it); all below `offset + cut` is removed."""

    normal: Floats
    offset: float
    cut: float

    def height(self, points: NDArray[np.floating]) -> Floats:
        """Signed distance (...) of `points` (..., 3) in front of the plane."""
        return np.asarray(points @ self.normal - self.offset, np.float64)

    def snap_to_plane(self, vertices: Floats, cell: float) -> Floats:
        """Project the `vertices` (v, 3) of the flat face at the cut onto the plane; the others are unchanged."""
        height = self.height(vertices)
        coordinates = np.abs(height - self.cut) < 0.3 * cell
        return vertices - np.where(coordinates, height, 0.0)[:, None] * self.normal


def find_support_plane(points: Floats, normals: Floats, weights: Floats, centres: Floats, seed: int) -> tuple[SupportPlane | None, str]:
    """The support plane (None when there is none) and the evidence for the log.

    `points` (n, 3) in the unit ball with unit `normals` (n, 3) and `weights` (n,) by area; `centres` (c, 3) of the cameras.
    """
    rng = np.random.default_rng(seed)
    subset = rng.choice(len(points), min(RANSAC_SAMPLES, len(points)), replace=False)
    p, n, w = points[subset], normals[subset], weights[subset]
    if not w.sum() > 0:
        return None, "there are no surfels"
    best, best_weight = None, 0.0
    for trial in rng.choice(len(p), RANSAC_TRIALS, p=w / w.sum()):
        offset = float(p[trial] @ n[trial])
        weight = float(w[_inliers(p, n, n[trial], offset)].sum())
        if weight > best_weight:
            best, best_weight = (n[trial], offset), weight
    if best is None:
        return None, "no plane found"
    normal, offset = best
    for _ in range(3):
        inliers = _inliers(p, n, normal, offset)
        if inliers.sum() < 10:
            return None, "no plane found"
        mean = np.average(p[inliers], axis=0, weights=w[inliers])
        covariance = (p[inliers] - mean).T @ ((p[inliers] - mean) * w[inliers][:, None])
        axis = np.linalg.eigh(covariance)[1][:, 0]
        normal = axis if axis @ normal > 0 else -axis
        offset = float(mean @ normal)
    inliers = _inliers(points, normals, normal, offset)
    share = float(weights[inliers].sum() / weights.sum())
    if share < MIN_PLANE_SHARE:
        return None, f"the largest plane contains {100 * share:.0f} % of the surface"
    in_front = float((centres @ normal > offset).mean())
    if in_front < MIN_CAMERA_SHARE:
        return None, f"{100 * (1 - in_front):.0f} % of the photos are taken from behind the largest plane"
    sectors = _sectors_reached(points[inliers], normal, offset)
    if sectors < MIN_SECTORS:
        return None, f"the largest plane ends inside the unit ball in {SECTORS - sectors} of {SECTORS} directions"
    height = points @ normal - offset
    cut = min(float(np.quantile(np.abs(height[inliers]), CUT_QUANTILE)), MAX_CUT)
    central = np.linalg.norm(points - (offset * normal), axis=1) < BORDER_RADIUS
    object_share = float(weights[central & (height > 2 * cut)].sum() / weights.sum())
    if object_share < MIN_OBJECT_SHARE:
        return None, f"only {100 * object_share:.1f} % of the surface stands on the largest plane"
    evidence = f"a plane with {100 * share:.0f} % of the surface reaches the unit ball in {sectors} of {SECTORS} directions"
    return SupportPlane(normal, offset, cut), evidence


def _inliers(points: Floats, normals: Floats, normal: Floats, offset: float) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points @ normal - offset) < MAX_DISTANCE) & (normals @ normal > MIN_COSINE))


def _sectors_reached(points: Floats, normal: Floats, offset: float) -> int:
    """Number of sectors of the plane's disc in the ball whose boundary the inliers `points` (n, 3) reach."""
    basis = np.linalg.svd(normal[None])[2][1:]
    coordinates = points @ basis.T
    disc_radius = float(np.sqrt(max(1 - offset**2, 0.0)))
    outer = np.linalg.norm(coordinates, axis=1) > BORDER_RADIUS * disc_radius
    sector = np.floor((np.arctan2(coordinates[outer, 1], coordinates[outer, 0]) / (2 * np.pi) % 1) * SECTORS).astype(int)
    return int((np.bincount(sector, minlength=SECTORS) >= 3).sum())


def remove_background_components(vertices: Floats, faces: NDArray[np.int32], radius: float) -> tuple[Floats, NDArray[np.int32], int]:
    """Remove components that reach beyond `radius` from the origin (walls, furniture); also returns the number removed.

    All are kept when every component above a fifth of the largest one's area does so: the object itself fills the ball.
    """
    if len(faces) == 0:
        return vertices, faces, 0
    component = face_components(vertices, faces)
    area = component_areas(vertices, faces, component)
    outer = (np.linalg.norm(vertices[faces], axis=2) > radius).any(1)
    crosses = np.bincount(component, outer) > 0
    keep = ~crosses
    exists = area > 0
    if not keep[exists].any() or area[keep].max() < 0.2 * area.max():
        return vertices, faces, 0
    return (*remove_unused_vertices(vertices, faces[keep[component]]), int((exists & ~keep).sum()))
