"""Depth maps to a surface: a sparse truncated signed distance field, closed where nothing was seen.

Two passes over the views, one view in memory at a time:
`survey` looks where the surface is: it marks the blocks each depth map touches and fuses the view into a small dense lattice;
`allocate` then fills what no view saw in that lattice (`gsbake.meshing.hole_filling`: a film of least area between what is known to be
inside and what is known to be empty) and adds the blocks where the closing surface runs; `integrate` fuses the views into the fine
blocks; `mesh` marches them.

Every block exists before the first view is integrated, so each sample hears every view: what one view puts in mid-air the others
carve away.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsbake.meshing.depth_views import DepthView, Floats
from gsbake.meshing.fusion_kernel import BY_DEPTH, BY_MASK, fuse_view, mark_depth, reach_tiles
from gsbake.meshing.hole_filling import crossing_blocks, diffuse, span
from gsbake.meshing.marching_cubes import coarse_values, march
from gsbake.meshing.sparse_lattice import EDGE, BlockLattice
from gsbake.meshing.support_plane import Support
from gsbake.surfels.raster.threads import run_chunks

#: The dense survey lattice has at most this many samples per axis.
SURVEY_SAMPLES = 128
#: Weight of a mask's vote against a head-on depth's (1): a hull is sharper than a splat's depth.
HULL_WEIGHT = 2.0
#: Weight of "empty here, far before the surface" against "the surface is near": one stray ray must not erode a thin part.
FREE_WEIGHT = 0.5
#: Emptiness that is seen with less than this weight per view that finds the place hidden is doubted.
DOUBT = 0.03
#: Fine sweeps that smooth the seam between what was seen and what was filled.
SEAM_SWEEPS, SEAM_ROUNDS = 12, 3
#: Steepness that turns the survey's known distances into sides before filling.
SIDE = 4.0
#: Rounds of reweighting on the survey lattice; the area hardly changes after these.
ROUNDS = 10


class FusedBlocks:
    """Running means of the distance (in units of `truncation`, negative inside) on a lattice's blocks."""

    def __init__(self, lattice: BlockLattice, truncation: float) -> None:
        self.lattice = lattice
        self.truncation = truncation
        shape = (len(lattice), EDGE, EDGE, EDGE)
        self.values = np.zeros(shape, np.float32)
        self.totals = np.zeros(shape, np.float32)
        self.seen = np.zeros(shape, np.uint8)
        self.hidden = np.zeros(shape, np.uint16)
        self.hidden_blocks = np.zeros(len(lattice), np.int32)

    @property
    def nbytes(self) -> int:
        """Memory of the samples in bytes."""
        return self.values.nbytes + self.totals.nbytes + self.seen.nbytes + self.hidden.nbytes

    def add(self, view: DepthView) -> None:
        """Fuse one view."""
        camera = view.camera
        fixed: tuple[Any, ...] = (
            self.lattice.coords,
            self.lattice.lower.astype(np.float32),
            np.float32(self.lattice.cell),
            np.float32(self.truncation),
            camera.R.astype(np.float32),
            camera.t.astype(np.float32),
            _intrinsics(view),
            view.inverse,
            view.weight,
            view.cosine,
            view.outside,
            reach_tiles(view.inverse, view.outside, np.float32(self.truncation)),
            np.float32(HULL_WEIGHT),
            np.float32(FREE_WEIGHT),
            self.values,
            self.totals,
            self.seen,
            self.hidden,
            self.hidden_blocks,
        )
        run_chunks(lambda start, stop: fuse_view(start, stop, *fixed), len(self.lattice))

    def doubt(self) -> None:
        """Forget "empty" where hardly any view says so and many say that it is hidden: rays that slipped through a gap.

        A mask's word stands. Without this, single rays hollow the inside out, where nothing speaks against them.
        """
        against = self.hidden + self.hidden_blocks[:, None, None, None]
        self.seen[(self.values > 0) & (self.totals < DOUBT * against) & (self.seen & BY_MASK == 0)] = 0


class SparseTsdf:
    """A field over the box `lower`..`upper` (3,), samples `cell` apart, distances truncated at `truncation` (same units).

    `ball` is the radius around the origin that holds the object: with `solid` (masks tell the object apart, so everything outside
    the ball is empty) the surface closes inside it; without, the surface is cut open there. Below the cut of a `support` all is empty.
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        cell: float,
        truncation: float,
        ball: float | None = None,
        solid: bool = True,
        support: Support | None = None,
    ) -> None:
        self.lattice = BlockLattice(lower, upper, cell)
        self.truncation = float(truncation)
        self.ball = ball
        self.solid = solid
        self.support = support
        self.ratio = max(4, -(-max(self.lattice.samples) // SURVEY_SAMPLES))
        coarse_cell = self.ratio * cell
        extent = np.array(self.lattice.samples) * cell
        coarse = BlockLattice(self.lattice.lower, self.lattice.lower + extent, coarse_cell)
        coarse.allocate_all()
        self.survey_field = FusedBlocks(coarse, max(self.truncation, 2 * coarse_cell))
        self._wanted = np.zeros(self.lattice.shape, np.bool_)
        self.near_share = 1.0  # of all blocks, those the surface may run through; known once allocated
        self._filled: Floats | None = None
        self._fused: FusedBlocks | None = None

    @property
    def nbytes(self) -> int:
        """Memory of the fine samples in bytes."""
        return 0 if self._fused is None else self._fused.nbytes

    def survey(self, view: DepthView) -> None:
        """First pass: note where this view sees the surface. Every view goes through here before `allocate`."""
        self.survey_field.add(view)
        camera, lattice = view.camera, self.lattice
        mark_depth(
            view.inverse,
            view.outside,
            camera.R.T / lattice.cell,
            (camera.centre - lattice.lower) / lattice.cell,
            _intrinsics(view).astype(np.float64),
            self.truncation / lattice.cell,
            self._wanted,
        )

    def allocate(self, everywhere: bool = False) -> None:
        """Between the passes: fill what no view saw (coarsely), and allocate the blocks the surface runs through, or all of them."""
        field = self.survey_field
        field.doubt()
        unknown = field.seen == 0
        field.values[field.seen == BY_MASK] = 1
        if self.solid:
            empty = self._outside(field.lattice)
            field.values[empty] = 1
            unknown &= ~empty
        if self.support is not None:
            below = self._below(field.lattice, slice(None), field.truncation)
            field.values[:] = np.maximum(field.values, below)
            unknown &= below < 0
        # The filling asks on which side a sample lies, not how far: a thin layer of "inside" must weigh as much as the wide empty space.
        np.clip(SIDE * field.values, -1, 1, out=field.values)
        longest = max(field.lattice.samples)
        rate = 2 / (1 + np.sin(np.pi / longest))  # the best over-relaxation for Laplace's equation across the box
        diffuse(field.lattice, field.values, unknown, longest, rate)
        span(field.lattice, field.values, unknown, crossing_blocks(field.lattice, field.values, unknown), longest // 4, rate, ROUNDS)
        filled = field.lattice.dense(field.values)
        self._filled = filled
        self._mark_crossings(filled)
        near = self._wanted & self._reachable()
        self.near_share = float(near.mean())
        self.lattice.allocate(near | everywhere)
        self._fused = FusedBlocks(self.lattice, self.truncation)

    def integrate(self, view: DepthView) -> None:
        """Second pass: fuse this view into the fine blocks."""
        if self._fused is None:
            raise RuntimeError("survey all views and allocate before integrating")
        self._fused.add(view)

    def set_field(self, field: Floats) -> None:
        """Instead of integrating: a field (n, 8, 8, 8) on `lattice`'s blocks in units of the truncation, not a number where unknown."""
        if self._fused is None or field.shape != self._fused.values.shape:
            raise ValueError("the field must have one value per sample of the allocated blocks")
        known = np.isfinite(field)
        self._fused.values[:] = np.where(known, field, 0)
        self._fused.seen[:] = np.where(known, BY_DEPTH, 0)

    def mesh(self, close: bool = True) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """The zero set as `vertices` (v, 3), `faces` (f, 3), outward winding; `close` fills what no view saw. Call it once, at the end."""
        fused, filled = self._fused, self._filled
        if fused is None or filled is None:
            raise RuntimeError("survey, allocate and integrate before meshing")
        fused.doubt()
        unknown = fused.seen == 0
        if close:
            scale = self.survey_field.truncation / self.truncation
            block = np.zeros((EDGE, EDGE, EDGE), np.float32)
            for row in np.flatnonzero(unknown.any(axis=(1, 2, 3))):
                coarse_values(filled, self.lattice.coords[row].astype(np.int64) * EDGE, float(self.ratio), scale, block)
                fused.values[row][unknown[row]] = block[unknown[row]]
            # Only a mask speaks here: certainly empty, so the filling must not lean on the mask's ramp.
            fused.values[fused.seen == BY_MASK] = np.maximum(fused.values[fused.seen == BY_MASK], 0.5)
            shallow = np.flatnonzero((unknown & (np.abs(fused.values) < 1)).any(axis=(1, 2, 3)))
            span(self.lattice, fused.values, unknown, shallow, SEAM_SWEEPS, 1.5, SEAM_ROUNDS)
            self._cut()
            vertices, faces = march(self.lattice, fused.values, filled, float(self.ratio), scale)
        else:
            fused.values[(fused.seen & BY_DEPTH) == 0] = np.nan
            self._cut()
            vertices, faces = march(self.lattice, fused.values)
        if self.ball is not None and not self.solid:
            keep = (np.linalg.norm(vertices, axis=1) <= self.ball)[faces].all(1)
            used, inverse = np.unique(faces[keep], return_inverse=True)
            vertices, faces = vertices[used], inverse.reshape(-1, 3).astype(np.int32)
        return vertices, faces

    def _below(self, lattice: BlockLattice, rows: slice, truncation: float) -> Floats:
        """Distance (n, 8, 8, 8) of the samples of some blocks below the support's cut, in units of `truncation`, kept in ±1."""
        assert self.support is not None
        height = self.support.height(lattice.positions(rows)) - self.support.cut
        return np.clip(-height / truncation, -1, 1).astype(np.float32)

    def _cut(self) -> None:
        """Empty the fine blocks below the support's cut, so that what stands on it ends there in a flat face."""
        assert self._fused is not None
        if self.support is None:
            return
        step = 1024  # blocks: the positions of all at once would take more than the field itself
        for start in range(0, len(self.lattice), step):
            rows = slice(start, start + step)
            self._fused.values[rows] = np.maximum(self._fused.values[rows], self._below(self.lattice, rows, self.truncation))

    def _outside(self, lattice: BlockLattice) -> NDArray[np.bool_]:
        """Samples outside the ball, and the outermost layer of the box: empty when the object is solid."""
        position = lattice.positions(slice(None))
        out = np.zeros(position.shape[:-1], np.bool_)
        if self.ball is not None:
            out |= (position**2).sum(-1) > self.ball**2
        steps = np.arange(EDGE)
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = EDGE
            whole = lattice.coords[:, axis, None, None, None] * EDGE + steps.reshape(shape)
            out |= (whole == 0) | (whole >= lattice.samples[axis] - 2)
        return out

    def _mark_crossings(self, filled: Floats) -> None:
        """Mark the fine blocks that the survey's zero set runs through."""
        crossing = np.zeros(filled.shape, np.bool_)
        inside = filled < 0
        for axis in range(3):
            a = [slice(None)] * 3
            b = [slice(None)] * 3
            a[axis], b[axis] = slice(None, -1), slice(1, None)
            step = inside[tuple(a)] != inside[tuple(b)]
            crossing[tuple(a)] |= step
            crossing[tuple(b)] |= step
        coarse = self.survey_field.lattice
        points = coarse.lower + coarse.cell * np.argwhere(crossing)
        self.lattice.mark_near(points, coarse.cell, self._wanted)

    def _reachable(self) -> NDArray[np.bool_]:
        """Blocks that touch the ball (all without one)."""
        if self.ball is None:
            return np.ones(self.lattice.shape, np.bool_)
        edge = EDGE * self.lattice.cell
        nearest = []
        for axis in range(3):
            low = self.lattice.lower[axis] + edge * np.arange(self.lattice.shape[axis])
            nearest.append(np.clip(0, low, low + edge))
        x, y, z = np.meshgrid(*nearest, indexing="ij")
        return np.asarray(x * x + y * y + z * z <= self.ball**2)


def _intrinsics(view: DepthView) -> Floats:
    camera = view.camera
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
