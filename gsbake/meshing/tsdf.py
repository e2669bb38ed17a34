"""Sparse truncated signed distance field (TSDF) of depth maps, closed by hole filling.

Two passes over the views, one view in memory at a time. `fuse_coarse` marks the blocks near each depth map and fuses the view into a small
dense lattice. `allocate` fills the unobserved samples of that lattice (`gsbake.meshing.hole_filling`: the minimal surface between known
inside and known free space) and allocates the marked blocks and those that the filled surface crosses. `integrate` fuses the views into
these blocks; `mesh` extracts the surface.

All blocks are allocated before the first view is integrated, so each sample takes every view: free space in other views removes outliers
of one view.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsbake.geometry.region import Region
from gsbake.geometry.sparse_lattice import EDGE, BlockLattice
from gsbake.kernels.threads import run_chunks
from gsbake.meshing.depth_views import DepthView, Floats
from gsbake.meshing.fusion_kernel import OBSERVED_BY_DEPTH, OBSERVED_BY_MASK, fuse_view, mark_blocks_near_depth, max_depth_tiles
from gsbake.meshing.hole_filling import minimise_area, sign_change_blocks, solve_laplace
from gsbake.meshing.marching_cubes import extract_isosurface, upsample_coarse
from gsbake.meshing.support_plane import SupportPlane

#: Maximum samples per axis of the dense coarse lattice.
COARSE_SAMPLES = 128
#: Weight of free space from a mask; a depth at normal incidence has 1. Masks are sharper than rendered depth.
MASK_WEIGHT = 2.0
#: Relative weight of free space far in front of a surface, so that single outlier rays do not erode thin parts.
FREE_SPACE_WEIGHT = 0.5
#: Minimum weight of observed free space per view in which the sample is occluded.
MIN_FREE_SPACE_RATIO = 0.03
#: Sweeps and rounds on the fine lattice that smooth the seam between observed and filled samples.
SEAM_SWEEPS, SEAM_ROUNDS = 12, 3
#: Factor before clamping that turns the coarse distances into signs for hole filling.
SIGN_SLOPE = 4.0
#: Reweighting rounds on the coarse lattice; the area hardly changes after these.
AREA_ROUNDS = 10


class TsdfBlocks:
    """Weighted means of the signed distance (in units of `truncation`, negative inside) on a lattice's blocks."""

    def __init__(self, lattice: BlockLattice, truncation: float) -> None:
        self.lattice = lattice
        self.truncation = truncation
        shape = (len(lattice), EDGE, EDGE, EDGE)
        self.values = np.zeros(shape, np.float32)
        self.weights = np.zeros(shape, np.float32)
        self.observed = np.zeros(shape, np.uint8)
        self.occluded = np.zeros(shape, np.uint16)
        self.occluded_blocks = np.zeros(len(lattice), np.int32)

    @property
    def nbytes(self) -> int:
        """Memory of the samples in bytes."""
        return self.values.nbytes + self.weights.nbytes + self.observed.nbytes + self.occluded.nbytes

    def add(self, view: DepthView) -> None:
        """Integrate one view."""
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
            view.mask_distance,
            max_depth_tiles(view.inverse, view.mask_distance, np.float32(self.truncation)),
            np.float32(MASK_WEIGHT),
            np.float32(FREE_SPACE_WEIGHT),
            self.values,
            self.weights,
            self.observed,
            self.occluded,
            self.occluded_blocks,
        )
        run_chunks(lambda start, stop: fuse_view(start, stop, *fixed), len(self.lattice))

    def reject_weak_free_space(self) -> None:
        """Mark free space as unobserved where few views observe it and many find it occluded: rays through gaps in the surface.

        Free space from masks is kept. Without this step single rays carve the interior, which no other view observes.
        """
        occlusions = self.occluded + self.occluded_blocks[:, None, None, None]
        self.observed[(self.values > 0) & (self.weights < MIN_FREE_SPACE_RATIO * occlusions) & (self.observed & OBSERVED_BY_MASK == 0)] = 0


class SparseTsdf:
    """TSDF over the box `lower`..`upper` (3,) with sample spacing `cell` and truncation distance `truncation` (same units).

    `ball` is the radius around the origin that contains the object. With `empty_outside` (there are masks or a support plane) all outside
    the ball is free space and the surface is closed inside it; without, the surface is cut open there. All below the cut of `support` and
    outside the `region` is free space.
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        cell: float,
        truncation: float,
        ball: float | None = None,
        empty_outside: bool = True,
        support: SupportPlane | None = None,
        region: Region | None = None,
    ) -> None:
        self.lattice = BlockLattice(lower, upper, cell)
        self.truncation = float(truncation)
        self.ball = ball
        self.empty_outside = empty_outside
        self.support, self.region = support, region
        self.ratio = max(4, -(-max(self.lattice.samples) // COARSE_SAMPLES))
        coarse_cell = self.ratio * cell
        extent = np.array(self.lattice.samples) * cell
        coarse = BlockLattice(self.lattice.lower, self.lattice.lower + extent, coarse_cell)
        coarse.allocate_all()
        self.coarse_field = TsdfBlocks(coarse, max(self.truncation, 2 * coarse_cell))
        self._marked = np.zeros(self.lattice.shape, np.bool_)
        self.near_share = 1.0  # share of the blocks near the surface, set by `allocate`
        self._filled: Floats | None = None  # the coarse field, and the same with the region's outside empty
        self._closed: Floats | None = None
        self._fused: TsdfBlocks | None = None

    @property
    def nbytes(self) -> int:
        """Memory of the fine samples in bytes."""
        return 0 if self._fused is None else self._fused.nbytes

    def fuse_coarse(self, view: DepthView) -> None:
        """First pass: mark the blocks near this view's depths and fuse it coarsely. Call it for every view before `allocate`."""
        self.coarse_field.add(view)
        camera, lattice = view.camera, self.lattice
        mark_blocks_near_depth(
            view.inverse,
            view.mask_distance,
            camera.R.T / lattice.cell,
            (camera.centre - lattice.lower) / lattice.cell,
            _intrinsics(view).astype(np.float64),
            self.truncation / lattice.cell,
            self._marked,
        )

    def allocate(self, all_blocks: bool = False) -> None:
        """Between the passes: fill unobserved coarse samples, and allocate the blocks near the surface, or `all_blocks`."""
        field = self.coarse_field
        field.reject_weak_free_space()
        unknown = field.observed == 0
        field.values[field.observed == OBSERVED_BY_MASK] = 1
        if self.empty_outside:
            empty = self._outside_ball(field.lattice)
            field.values[empty] = 1
            unknown &= ~empty
        if self.support is not None:
            below = self._support_distance(field.lattice, slice(None), field.truncation)
            field.values[:] = np.maximum(field.values, below)
            unknown &= below < 0
        # Hole filling uses signs, not distances: a thin layer of inside samples must weigh as much as wide free space.
        np.clip(SIGN_SLOPE * field.values, -1, 1, out=field.values)
        longest = max(field.lattice.samples)
        rate = 2 / (1 + np.sin(np.pi / longest))  # optimal over-relaxation for Laplace's equation on the box
        solve_laplace(field.lattice, field.values, unknown, longest, rate)
        blocks = sign_change_blocks(field.lattice, field.values, unknown)
        minimise_area(field.lattice, field.values, unknown, blocks, longest // 4, rate, AREA_ROUNDS)
        self._filled = self._closed = field.lattice.dense(field.values)
        if self.region is not None:  # after the filling, whose least area would draw the cut inwards
            outside = np.clip(SIGN_SLOPE * self._region_distance(field.lattice, slice(None), field.truncation), -1, 1)
            self._closed = field.lattice.dense(np.maximum(field.values, outside))
        self._mark_crossings(self._closed)
        near_surface = self._marked & self._blocks_in_ball()
        self.near_share = float(near_surface.mean())
        self.lattice.allocate(near_surface | all_blocks)
        self._fused = TsdfBlocks(self.lattice, self.truncation)

    def evaluate_coarse(self, evaluate: Callable[[BlockLattice, float], Floats]) -> None:
        """Instead of the first pass: a field that is known everywhere. `evaluate` returns it on a lattice's blocks in units of a length."""
        coarse = self.coarse_field
        coarse.values[:] = evaluate(coarse.lattice, coarse.truncation)
        coarse.observed[:] = OBSERVED_BY_DEPTH
        edge = EDGE * self.lattice.cell
        corners = BlockLattice(self.lattice.lower, self.lattice.lower + (np.array(self.lattice.shape) + 1) * edge, edge)
        corners.allocate_all()
        near = np.abs(corners.dense(evaluate(corners, 2 * edge))) < 0.5  # within a block's edge of the surface
        for corner in np.ndindex(2, 2, 2):
            at = tuple(slice(c, c + n) for c, n in zip(corner, self.lattice.shape, strict=True))
            self._marked |= near[at]

    def integrate(self, view: DepthView) -> None:
        """Second pass: fuse this view into the fine blocks. Raises RuntimeError before `allocate`."""
        if self._fused is None:
            raise RuntimeError("call fuse_coarse for all views and allocate before integrate")
        self._fused.add(view)

    def set_field(self, field: Floats) -> None:
        """Instead of integrating: a field (n, 8, 8, 8) on the lattice's blocks in units of the truncation; NaN = unknown."""
        if self._fused is None or field.shape != self._fused.values.shape:
            raise ValueError("the field must have one value per sample of the allocated blocks")
        known = np.isfinite(field)
        self._fused.values[:] = np.where(known, field, 0)
        self._fused.observed[:] = np.where(known, OBSERVED_BY_DEPTH, 0)

    def mesh(self, close: bool = True) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Zero set as `vertices` (v, 3), `faces` (f, 3), outward winding; `close` fills holes. Call it once, at the end."""
        fused, filled, closed = self._fused, self._filled, self._closed
        if fused is None or filled is None or closed is None:
            raise RuntimeError("call fuse_coarse, allocate and integrate before mesh")
        fused.reject_weak_free_space()
        unknown = fused.observed == 0
        if close:
            scale = self.coarse_field.truncation / self.truncation
            block = np.zeros((EDGE, EDGE, EDGE), np.float32)
            for row in np.flatnonzero(unknown.any(axis=(1, 2, 3))):
                upsample_coarse(filled, self.lattice.coords[row].astype(np.int64) * EDGE, float(self.ratio), scale, block)
                fused.values[row][unknown[row]] = block[unknown[row]]
            # Observed by masks only: certainly free space, so hole filling must not follow the ramp of the mask distance.
            fused.values[fused.observed == OBSERVED_BY_MASK] = np.maximum(fused.values[fused.observed == OBSERVED_BY_MASK], 0.5)
            unknown_near_surface = np.flatnonzero((unknown & (np.abs(fused.values) < 1)).any(axis=(1, 2, 3)))
            minimise_area(self.lattice, fused.values, unknown, unknown_near_surface, SEAM_SWEEPS, 1.5, SEAM_ROUNDS)
            self._apply_cuts()
            vertices, faces = extract_isosurface(self.lattice, fused.values, closed, float(self.ratio), scale)
        else:
            fused.values[(fused.observed & OBSERVED_BY_DEPTH) == 0] = np.nan
            self._apply_cuts()
            vertices, faces = extract_isosurface(self.lattice, fused.values)
        if self.ball is not None and not self.empty_outside:
            keep = (np.linalg.norm(vertices, axis=1) <= self.ball)[faces].all(1)
            used, inverse = np.unique(faces[keep], return_inverse=True)
            vertices, faces = vertices[used], inverse.reshape(-1, 3).astype(np.int32)
        return vertices, faces

    def _support_distance(self, lattice: BlockLattice, rows: slice, truncation: float) -> Floats:
        """Distance (n, 8, 8, 8) of the samples of some blocks below the support's cut, in units of `truncation`, clamped to ±1."""
        assert self.support is not None
        height = self.support.height(lattice.positions(rows)) - self.support.cut
        return np.clip(-height / truncation, -1, 1).astype(np.float32)

    def _region_distance(self, lattice: BlockLattice, rows: slice, truncation: float) -> Floats:
        """Distance (n, 8, 8, 8) of the samples of some blocks to the region, as `_support_distance`."""
        assert self.region is not None
        return np.clip(self.region.distance(lattice.positions(rows)) / truncation, -1, 1).astype(np.float32)

    def _apply_cuts(self) -> None:
        """Set the fine samples below the support's cut and outside the region to free space; the object ends there in flat faces."""
        assert self._fused is not None
        cuts = [self._support_distance] * (self.support is not None) + [self._region_distance] * (self.region is not None)
        step = 1024  # blocks; all positions at once would need more memory than the field
        for start in range(0, len(self.lattice), step):
            rows = slice(start, start + step)
            for cut in cuts:
                self._fused.values[rows] = np.maximum(self._fused.values[rows], cut(self.lattice, rows, self.truncation))

    def _outside_ball(self, lattice: BlockLattice) -> NDArray[np.bool_]:
        """Samples outside the ball, and the outermost layer of the box."""
        position = lattice.positions(slice(None))
        out = np.zeros(position.shape[:-1], np.bool_)
        if self.ball is not None:
            out |= (position**2).sum(-1) > self.ball**2
        steps = np.arange(EDGE)
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = EDGE
            sample_index = lattice.coords[:, axis, None, None, None] * EDGE + steps.reshape(shape)
            out |= (sample_index == 0) | (sample_index >= lattice.samples[axis] - 2)
        return out

    def _mark_crossings(self, filled: Floats) -> None:
        """Mark the fine blocks that the coarse zero set crosses."""
        crossing = np.zeros(filled.shape, np.bool_)
        inside = filled < 0
        for axis in range(3):
            a = [slice(None)] * 3
            b = [slice(None)] * 3
            a[axis], b[axis] = slice(None, -1), slice(1, None)
            step = inside[tuple(a)] != inside[tuple(b)]
            crossing[tuple(a)] |= step
            crossing[tuple(b)] |= step
        coarse = self.coarse_field.lattice
        points = coarse.lower + coarse.cell * np.argwhere(crossing)
        self.lattice.mark_blocks_near(points, coarse.cell, self._marked)

    def _blocks_in_ball(self) -> NDArray[np.bool_]:
        """Blocks that intersect the ball (all without one)."""
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
