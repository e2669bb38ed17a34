"""Moving a mesh along its normals until the photos of textured places agree.

Masks cut a little outside or inside the object and splats reach beyond their centres: all views err alike, and no mean over them
helps. Texture tells better (`photometric_measure`). What photos measure is spread over the mesh by a screened least-squares system, so
that glossy and plain places follow their textured neighbours or stay; Geman-McClure weights take out what contradicts the result. As a
refinement of meshes: Vu et al., *High accuracy and visibility-consistent dense multiview stereo*, PAMI 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from gsbake.meshing.cleanup import Faces, Vertices
from gsbake.meshing.refinement.laplacian import spread
from gsbake.meshing.refinement.normals import vertex_normals
from gsbake.meshing.refinement.photometric_measure import Capture, Doubles, Plan, Samples, measure

#: Information (per square pixel) about differences of the displacement along edges, and about its being 0 per area of a patch.
SMOOTH, STAY = 0.4, 0.03
#: Displacements differ from a good measurement by about this many pixels.
ROBUST = 0.6
#: Solutions with weights from the one before.
REWEIGHT = 3
#: Vertices are moved at most this many pixels a round.
LIMIT = 2.0
#: A round whose median displacement is below this many pixels is not made.
SETTLED = 0.1


@dataclass(frozen=True)
class Agreed:
    """The moved `vertices` (v, 3); `share` of the measured vertices that most photos agree about, their median displacement `move` in
    pixels (summed over rounds), their median NCC `before` and `after`; `rounds` made: 0 where nothing was measured or gained."""

    vertices: Vertices
    share: float
    move: float
    before: float
    after: float
    rounds: int


def solve(samples: Samples, plan: Plan, count: int) -> Doubles:
    """Displacements (count,) in world units that follow the samples and vary slowly between them."""
    # Patches overlap: a measurement counts as much as the part of a patch that is its own.
    stride = -(-count // len(plan.chosen))
    weight, target = samples.weights() * min(stride * plan.share, 1.0), samples.shift / plan.pixel
    found = np.zeros(count)
    for turn in range(REWEIGHT):
        apart = (target - found[samples.vertex]) / ROBUST
        each = weight / (1 + apart**2) ** 2 if turn else weight
        data = sparse.diags(np.bincount(samples.vertex, each, count) + STAY * plan.share)
        right = np.asarray(np.bincount(samples.vertex, each * target, count), np.float64)
        found = spread(data, right, plan.edges, SMOOTH)
    return np.clip(found, -LIMIT, LIMIT) * plan.pixel


def gains(before: Samples, after: Samples) -> bool:
    """Whether most of the measurements `before` that have a weight match better in `after`.

    Their mean is no judge: the few whose patch slips off the surface or behind an edge lose a hundred times what the others gain.
    """
    mine, theirs = before.shared(after)
    return len(mine) > 0 and float(np.median(after.ncc[theirs] - before.ncc[mine])) > 0


def agree(vertices: Vertices, faces: Faces, capture: Capture, rounds: int, threads: int) -> Agreed:
    """Move the `vertices` (v, 3) of a mesh (unit frame, wound outward) until the photos of textured places agree.

    A round after which most of the same measurements match no better than before is taken back, and is the last.
    """
    plan = Plan.make(vertices, faces, capture.cameras)
    first = samples = measure(vertices, plan, capture, threads)
    moves: list[float] = []
    while len(moves) < rounds:
        trusted = np.unique(samples.vertex[samples.weights() > 0])
        if len(trusted) == 0:
            break
        shift = solve(samples, plan, len(vertices))
        move = float(np.median(np.abs(shift[trusted]))) / plan.pixel
        if move < SETTLED:
            break
        moved = vertices + vertex_normals(vertices, faces) * shift[:, None]
        later = measure(moved, plan, capture, threads)
        if not gains(samples, later):
            break
        vertices, samples = moved, later
        moves.append(move)
    mine, theirs = first.shared(samples)
    before, after = (float(np.median(ncc)) if len(mine) else 0.0 for ncc in (first.ncc[mine], samples.ncc[theirs]))
    return Agreed(vertices, len(np.unique(first.vertex[mine])) / len(plan.chosen), sum(moves), before, after, len(moves))
