"""The surface that an object stands on (or hangs from), told from surfels or points when no masks tell the object apart.

A plane by RANSAC (Fischler & Bolles, *Random sample consensus*, CACM 1981) over oriented samples, refined by weighted least squares. It is
a support only when it behaves like one: it goes on to the rim of the unit ball on most sides, the cameras are before it, and something
stands on it in the middle. A lid or a wall of the object itself ends before the rim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Samples within this distance of the plane (unit frame) whose normals are within 25 degrees of its own belong to it.
THICKNESS, COSINE = 0.02, 0.906
#: Planes tried, each from one sample and its normal, and samples that each is counted on.
TRIALS, COUNTED = 400, 20_000
#: Sides that are looked at, how far out (of the plane's disc in the ball) the plane must go on, and on how many sides: bare paper
#: shows few surfels.
SIDES, FAR_OUT, ENOUGH_SIDES = 12, 0.75, 7
#: Least share of the samples' weight on the plane, and standing on it within the middle.
PLANE_SHARE, OBJECT_SHARE = 0.1, 0.03
#: Least share of the cameras that are before the plane.
CAMERAS_BEFORE = 0.9
#: The cut lies above this share of the plane's own samples, and at most this far above it.
ABOVE, HIGHEST = 0.98, 0.03


@dataclass(frozen=True)
class Support:
    """The plane `normal` · x = `offset` (unit frame, the object before it); what lies below `offset + cut` is support."""

    normal: Floats
    offset: float
    cut: float

    def height(self, points: NDArray[np.floating]) -> Floats:
        """Distance (...) of `points` (..., 3) before the plane."""
        return np.asarray(points @ self.normal - self.offset, np.float64)

    def ground(self, vertices: Floats, cell: float) -> Floats:
        """`vertices` (v, 3) of a mesh that ends at the cut, with those of the cut's flat face set down on the plane itself."""
        height = self.height(vertices)
        flat = np.abs(height - self.cut) < 0.3 * cell
        return vertices - np.where(flat, height, 0.0)[:, None] * self.normal


def find_support(points: Floats, normals: Floats, weights: Floats, centres: Floats, seed: int) -> tuple[Support | None, str]:
    """The support (None when there is none) and the evidence in words.

    `points` (n, 3) in the unit ball with unit `normals` (n, 3) and `weights` (n,) by area; `centres` (c, 3) of the cameras.
    """
    rng = np.random.default_rng(seed)
    some = rng.choice(len(points), min(COUNTED, len(points)), replace=False)
    p, n, w = points[some], normals[some], weights[some]
    best, most = None, 0.0
    for pick in rng.choice(len(p), TRIALS, p=w / w.sum()):
        offset = float(p[pick] @ n[pick])
        held = float(w[_on(p, n, n[pick], offset)].sum())
        if held > most:
            best, most = (n[pick], offset), held
    if best is None:
        return None, "no plane found"
    normal, offset = best
    for _ in range(3):
        on = _on(p, n, normal, offset)
        if on.sum() < 10:
            return None, "no plane found"
        mean = np.average(p[on], axis=0, weights=w[on])
        spread = (p[on] - mean).T @ ((p[on] - mean) * w[on][:, None])
        axis = np.linalg.eigh(spread)[1][:, 0]
        normal = axis if axis @ normal > 0 else -axis
        offset = float(mean @ normal)
    on = _on(points, normals, normal, offset)
    share = float(weights[on].sum() / weights.sum())
    if share < PLANE_SHARE:
        return None, f"the largest plane holds {100 * share:.0f} % of the surface"
    before = float((centres @ normal > offset).mean())
    if before < CAMERAS_BEFORE:
        return None, f"{100 * (1 - before):.0f} % of the photos were taken from behind the largest plane"
    sides = _sides_reached(points[on], normal, offset)
    if sides < ENOUGH_SIDES:
        return None, f"the largest plane ends before the rim on {SIDES - sides} of {SIDES} sides"
    height = points @ normal - offset
    cut = min(float(np.quantile(np.abs(height[on]), ABOVE)), HIGHEST)
    middle = np.linalg.norm(points - (offset * normal), axis=1) < FAR_OUT
    standing = float(weights[middle & (height > 2 * cut)].sum() / weights.sum())
    if standing < OBJECT_SHARE:
        return None, f"only {100 * standing:.1f} % of the surface stands on the largest plane"
    evidence = f"a plane with {100 * share:.0f} % of the surface reaches the rim on {sides} of {SIDES} sides, all photos look at its front"
    return Support(normal, offset, cut), evidence


def _on(points: Floats, normals: Floats, normal: Floats, offset: float) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points @ normal - offset) < THICKNESS) & (normals @ normal > COSINE))


def _sides_reached(points: Floats, normal: Floats, offset: float) -> int:
    """On how many of SIDES sectors around the plane's disc in the ball its own `points` (n, 3) come near the disc's rim."""
    along = np.linalg.svd(normal[None])[2][1:]
    flat = points @ along.T
    disc = float(np.sqrt(max(1 - offset**2, 0.0)))
    far = np.linalg.norm(flat, axis=1) > FAR_OUT * disc
    sector = np.floor((np.arctan2(flat[far, 1], flat[far, 0]) / (2 * np.pi) % 1) * SIDES).astype(int)
    return int((np.bincount(sector, minlength=SIDES) >= 3).sum())


def drop_surroundings(vertices: Floats, faces: NDArray[np.int32], rim: float) -> tuple[Floats, NDArray[np.int32], int]:
    """Without loose pieces that reach beyond `rim` from the origin, such as a wall behind; also how many went.

    All stay when every piece of a fifth of the largest one's area does so: then the object itself is as large as the ball.
    """
    from gsbake.meshing.cleanup import drop_unused, piece_of_faces  # here, for it loads PyMeshLab, which the field does not need

    if len(faces) == 0:
        return vertices, faces, 0
    piece = piece_of_faces(vertices, faces)
    corners = vertices[faces]
    area = np.bincount(piece, np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))
    far = (np.linalg.norm(corners, axis=2) > rim).any(1)
    reaching = np.bincount(piece, far) > 0
    keep = ~reaching
    there = area > 0
    if not keep[there].any() or area[keep].max() < 0.2 * area.max():
        return vertices, faces, 0
    return (*drop_unused(vertices, faces[keep[piece]]), int((there & ~keep).sum()))
