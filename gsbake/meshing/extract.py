"""From trained surfels to a mesh: rendered depth maps, one distance field, marching cubes, clean-up, refinement, decimation."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Mesh
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.geometry.ply import write_mesh
from gsbake.meshing import cleanup
from gsbake.meshing.depth_cache import ViewSpool
from gsbake.meshing.depth_views import DepthView, depth_noise
from gsbake.meshing.imls import imls_field
from gsbake.meshing.refinement.normals import NormalGather, follow_normals
from gsbake.meshing.refinement.silhouette import polish
from gsbake.meshing.resolution import Resolution, choose, pixel_footprint, surfel_spacing
from gsbake.meshing.stereo_depth import with_measured
from gsbake.meshing.support_plane import Support, drop_surroundings, find_support
from gsbake.meshing.tsdf import SparseTsdf
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip, skips
from gsbake.mvs.depth_maps import read_depth
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.render import SurfelRenderer

Doubles = NDArray[np.float64]
Faces = NDArray[np.int32]

#: The object lies in the unit sphere; a little more, so that its outermost point is not cut.
BALL = 1.05
#: Truncation in voxels, at least and at most; between them three times the depth noise.
TRUNCATION_CELLS = (4.0, 10.0)
#: A stereo depth replaces a rendered one that differs by less than this many voxels.
STEREO_CELLS = 3.0
#: Photos kept in memory for photometric refinement, in bytes.
PHOTO_BYTES = 1 << 29
#: Surfels below this share of the transfer's peak opacity are ignored.
MIN_OPACITY = 0.05
#: Holes with more boundary edges are openings when nothing tells inside from outside.
MAX_HOLE_EDGES = 400


@dataclass(frozen=True)
class MeshOptions:
    """Settings of mesh extraction; `train_size` and `stereo_size` are the longer sides in pixels at which surfels were trained and photos
    matched, `empty_cells` is the rule of [skip]."""

    mesh: Mesh = Mesh()
    train_size: int = 512
    stereo_size: int = 800
    empty_cells: Rule = "auto"


@dataclass(frozen=True)
class Samples:
    """The surfels on their zero set: `points` (n, 3), outward `normals` (n, 3), `weights` (n,) by area and opacity."""

    points: Doubles
    normals: Doubles
    weights: Doubles


def extract_mesh(
    poses: Path,
    surfels: Path,
    out: Path,
    options: MeshOptions | None = None,
    *,
    stereo: Path | None = None,
    seed: int = 0,
    threads: int = 2,
    device: str = "cpu",
    scratch: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Mesh the surfels of the folder `surfels`; write `dense.ply` and `mesh.ply` (unit frame) into `out` and return the figures.

    `stereo` is the folder that `run_stereo` wrote; depth maps are kept below `scratch` while the field is built. Raises BadInputError when
    the surfels show no surface.
    """
    run = _Extraction(PosedPhotos.open(poses, surfels), surfels, stereo, out, options or MeshOptions(), seed, threads, device, monitor)
    with tempfile.TemporaryDirectory(dir=scratch, prefix="depth-") as folder:
        return run.extract(ViewSpool(Path(folder)))


@dataclass
class _Extraction:
    """One run: what it reads, and how."""

    posed: PosedPhotos
    surfels: Path
    stereo: Path | None
    out: Path
    options: MeshOptions
    seed: int
    threads: int
    device: str
    monitor: Monitor

    def extract(self, spool: ViewSpool) -> dict[str, Any]:
        """The recipe."""
        samples = self._samples()
        lower, upper, resolution = self._choose_resolution(samples.points)
        with self.monitor.part("depth"):
            self._render(spool, resolution)
        noise = _noise(spool)
        cells = min(max(3 * noise / resolution.cell, TRUNCATION_CELLS[0]), TRUNCATION_CELLS[1])
        evidence = f"median depth difference between neighbouring views {noise / resolution.cell:.2f} voxels"
        self.monitor.decide("truncation", f"{cells:.1f} voxels", evidence)
        support = self._support(samples)
        field = self._field(spool, lower, upper, resolution, cells * resolution.cell, support, samples)
        with self.monitor.part("marching"):
            vertices, faces = field.mesh(close=self.options.mesh.holes == "close")
        del field
        if len(faces) == 0:
            raise BadInputError(
                "mesh: the trained surfels show no surface inside the object's sphere; look at the training figures in the report, "
                "give masks, or train longer (train.iterations)."
            )
        with self.monitor.part("clean"):
            vertices, faces, dropped = self._clean(vertices, faces, spool, resolution.cell, support)
        with self.monitor.part("silhouettes"):
            vertices = self._refine_silhouettes(vertices, faces)
        with self.monitor.part("photos"):
            vertices, agreed = self._refine_photometric(vertices, faces, resolution.cell)
        write_mesh(self.out / "dense.ply", vertices, faces)
        self.monitor.check_stop()
        with self.monitor.part("decimate"):
            figures = self._decimate(vertices, faces, resolution.cell)
        return figures | {
            "dense_vertices": len(vertices),
            "dense_faces": len(faces),
            "cell": resolution.cell,
            "cells": resolution.cells,
            "depth_noise_cells": noise / resolution.cell,
            "dropped_components": dropped,
            **agreed,
        }

    def _samples(self) -> Samples:
        """The surfels inside the ball that are opaque enough."""
        surfels = Surfels.load(self.surfels / "surfels.safetensors")
        normal = surfels.normal().detach().cpu().numpy().astype(np.float64)
        sdf = surfels.sdf.detach().cpu().numpy().astype(np.float64).reshape(-1, 1)
        points = surfels.position.detach().cpu().numpy().astype(np.float64) - sdf * normal
        weights = surfels.scale.detach().cpu().numpy().astype(np.float64).prod(1)
        opacity = surfels.opacity().detach().cpu().numpy().astype(np.float64).reshape(-1)
        keep = np.isfinite(points).all(1) & (np.linalg.norm(points, axis=1) <= BALL) & (opacity > MIN_OPACITY * surfels.transfer.peak)
        if keep.sum() < 10:
            raise BadInputError(
                "mesh: fewer than ten surfels lie in the object's sphere; the training failed, see its figures in the report."
            )
        weights = (weights * opacity)[keep]
        return Samples(points[keep], normal[keep], weights / max(float(np.median(weights)), 1e-12))

    def _choose_resolution(self, points: Doubles) -> tuple[Doubles, Doubles, Resolution]:
        """The object's padded box, and the voxel size with its reason."""
        lower, upper = points.min(0), points.max(0)
        cameras = [camera.within(self.options.train_size) for camera in self.posed.cameras.cameras]
        settings = self.options.mesh
        footprint = pixel_footprint(cameras, (lower + upper) / 2)
        longest = float((upper - lower).max())
        resolution = choose(longest, surfel_spacing(points), footprint, settings.resolution, settings.max_resolution)
        self.monitor.decide("field resolution", f"{resolution.cells} voxels of {resolution.cell:.4g}", resolution.reason)
        pad = 16 * resolution.cell  # room for the truncation and for the boundary layers of the survey
        return np.maximum(lower - pad, -BALL - pad), np.minimum(upper + pad, BALL + pad), resolution

    def _render(self, spool: ViewSpool, resolution: Resolution) -> None:
        """Depth and normals at every photo's pose into the spool; stereo depths replace rendered ones that agree with them."""
        renderer = SurfelRenderer.load(self.surfels, self.device)
        shares: list[float] = []
        for index in range(len(self.posed)):
            self.monitor.check_stop()
            photo = self.posed.view(index, self.options.train_size)
            buffers = renderer.gbuffer(photo.camera)
            view = DepthView.from_gbuffer(photo.camera, buffers, photo.mask, TRUNCATION_CELLS[0] * resolution.cell)
            measured = None if self.stereo is None else self.stereo / "depth" / f"{photo.camera.name}.npz"
            if measured is not None and measured.exists():
                view, share = with_measured(view, *read_depth(measured), STEREO_CELLS * resolution.cell)
                shares.append(share)
            spool.append(view, buffers["normal"])
            self.monitor.progress(index + 1, len(self.posed), "depth maps")
        if shares:
            share = 100 * sum(shares) / len(shares)
            self.monitor.decide("depth maps", f"{share:.0f} % from stereo", f"where rendered depth agrees to {STEREO_CELLS:g} voxels")

    def _support(self, samples: Samples) -> Support | None:
        """The plane that the object stands on, which is removed from the mesh; not searched for where there are masks."""
        if self.posed.has_masks or self.options.mesh.support_plane == "keep":
            return None
        centres = np.stack([camera.centre for camera in self.posed.cameras.cameras])
        found, evidence = find_support(samples.points, samples.normals, samples.weights, centres, self.seed)
        self.monitor.decide("support plane", "part of the object" if found is None else "removed", evidence)
        return found

    def _field(
        self, spool: ViewSpool, lower: Doubles, upper: Doubles, resolution: Resolution, truncation: float, support: Support | None,
        samples: Samples,
    ) -> SparseTsdf:  # fmt: skip
        """The distance field, from depth maps or from the surfels' SDF samples."""
        monitor, solid = self.monitor, self.posed.has_masks or support is not None
        field = SparseTsdf(lower, upper, resolution.cell, truncation, ball=BALL, solid=solid, support=support)
        with monitor.part("survey"):
            for done, view in enumerate(spool):
                monitor.check_stop()
                field.survey(view)
                monitor.progress(done + 1, 2 * len(spool), "fusing")
        rule = self.options.empty_cells
        with monitor.part("filling"):
            field.allocate(everywhere=not skips(rule, holds=True))
        with monitor.part("fusion"):
            if self.options.mesh.field == "imls":
                field.set_field(imls_field(field.lattice, samples.points, samples.normals, truncation, samples.weights))
            else:
                for done, view in enumerate(spool):
                    monitor.check_stop()
                    field.integrate(view)
                    monitor.progress(len(spool) + done + 1, 2 * len(spool), "fusing")
        count = np.prod(field.lattice.samples) / 1e6
        cells = f"{100 * field.near_share:.1f} % of the grid's {count:.1f} million voxels lie near the surface"
        evidence = f"{cells}; those filled take {field.nbytes / 1e6:.0f} MB"
        decide_skip(monitor, "empty_cells", rule, True, evidence, "empty voxels skipped", "all voxels filled")
        return field

    def _clean(
        self, vertices: Doubles, faces: Faces, spool: ViewSpool, cell: float, support: Support | None
    ) -> tuple[Doubles, Faces, int]:
        """Remove loose components and surroundings, integrate rendered normals, smooth, close holes; how many components went."""
        settings, around = self.options.mesh, 0
        if support is not None:
            vertices, faces, around = drop_surroundings(vertices, faces, BALL - 3 * cell)
            vertices = support.ground(vertices, cell)
        vertices, faces, dropped = cleanup.drop_small(vertices, faces, settings.min_component)
        if settings.normal_wavelength > 0:
            vertices = _integrate_normals(spool, vertices, faces, settings.normal_wavelength, cell)
        vertices = cleanup.smooth(vertices, faces, settings.smoothing_iterations)
        if not cleanup.topology(vertices, faces).watertight:
            vertices, faces = cleanup.repair(vertices, faces)
            if settings.holes == "close":
                vertices, faces = cleanup.close_holes(vertices, faces, MAX_HOLE_EDGES)
        return vertices, faces, dropped + around

    def _refine_silhouettes(self, vertices: Doubles, faces: Faces) -> Doubles:
        """Vertices moved until the silhouettes meet the masks, where every photo has one."""
        iterations, monitor = self.options.mesh.silhouette_iterations, self.monitor
        if not iterations or not self.posed.has_masks:
            reason = "not every photo has a mask" if iterations else "set by the profile"
            monitor.decide("silhouette refinement", "skipped", reason)
            return vertices

        def views() -> Iterator[tuple[Camera, NDArray[np.uint8]]]:
            for index in range(len(self.posed)):
                monitor.check_stop()
                view = self.posed.view(index)
                if view.mask is not None:
                    yield view.camera, view.mask

        polished = polish(vertices, faces, views, iterations, self.threads)
        if polished.rims == 0:
            monitor.decide("silhouette refinement", "no change", "the mesh's contours lie near the masks' boundaries hardly anywhere")
        else:
            evidence = f"{polished.rims} contour points, median distance to the masks' boundaries {polished.before:+.2f} px"
            monitor.decide("silhouette refinement", f"now {polished.after:+.2f} px", evidence)
        return polished.vertices

    def _refine_photometric(self, vertices: Doubles, faces: Faces, cell: float) -> tuple[Doubles, dict[str, float]]:
        """Vertices moved until photos of textured surfaces agree, where stereo confirmed depths; with figures for the manifest."""
        from functools import lru_cache

        from gsbake.meshing.refinement.photometric import agree
        from gsbake.meshing.refinement.photometric_measure import Capture
        from gsbake.mvs.pyramids import Photo, load_photo

        iterations, size = self.options.mesh.photometric_iterations, self.options.stereo_size
        files = [] if self.stereo is None else [self.stereo / "depth" / f"{camera.name}.npz" for camera in self.posed.cameras.cameras]
        if not iterations or not any(file.exists() for file in files):
            self.monitor.decide("photometric refinement", "skipped", "stereo confirmed no depths" if iterations else "set by the profile")
            return vertices, {}
        cameras = [camera.within(size) for camera in self.posed.cameras.cameras]

        @lru_cache(maxsize=max(8, PHOTO_BYTES // (2 * max(c.width * c.height for c in cameras))))
        def photo(index: int) -> Photo:
            self.monitor.check_stop()
            return load_photo(self.posed, index, size)

        capture = Capture(cameras, photo, lambda index: read_depth(files[index]) if files[index].exists() else None, STEREO_CELLS * cell)
        agreed = agree(vertices, faces, capture, iterations, self.threads)
        evidence = f"{100 * agreed.share:.0f} % of the surface points look alike in most photos"
        if agreed.rounds:
            evidence += f"; NCC {agreed.before:.3f} → {agreed.after:.3f}"
            self.monitor.decide("photometric refinement", f"moved by {agreed.move:.2f} px in the median", evidence)
        else:
            self.monitor.decide("photometric refinement", "no change", f"{evidence}; moving gains nothing")
        return agreed.vertices, {
            "photometric_share": agreed.share,
            "photometric_move_pixels": agreed.move,
            "photometric_ncc_before": agreed.before,
            "photometric_ncc_after": agreed.after,
        }

    def _decimate(self, vertices: Doubles, faces: Faces, cell: float) -> dict[str, Any]:
        """Write the low-poly mesh; its figures."""
        low_vertices, low_faces, error = cleanup.decimate(vertices, faces, self.options.mesh.faces)
        low = cleanup.topology(low_vertices, low_faces)
        if low.non_manifold_edges:
            low_vertices, low_faces = cleanup.repair(low_vertices, low_faces)
            low = cleanup.topology(low_vertices, low_faces)
        write_mesh(self.out / "mesh.ply", low_vertices, low_faces)
        if error > 2 * cell:
            self.monitor.warn(
                f"mesh: decimation to {len(low_faces)} faces moves the surface by up to {error / cell:.1f} voxels; "
                "raise mesh.faces to keep it."
            )
        return {
            "vertices": len(low_vertices),
            "faces": len(low_faces),
            "components": low.components,
            "watertight": low.watertight,
            "border_edges": low.border_edges,
            "decimation_error_cells": error / cell,
        }


def _noise(spool: ViewSpool) -> float:
    """Median difference (unit frame) of neighbouring views' depths; 0 when no two views overlap."""
    directions = np.stack([spool.view(index).camera.view_direction for index in range(len(spool))])
    gaps = []
    for index in range(0, len(spool), max(1, len(spool) // 12)):
        closeness = directions @ directions[index]
        closeness[index] = -2
        gap = depth_noise(spool.view(index), spool.view(int(closeness.argmax())))
        if gap is not None:
            gaps.append(gap)
    return float(np.median(gaps)) if gaps else 0.0


def _integrate_normals(spool: ViewSpool, vertices: Doubles, faces: Faces, wavelength: float, cell: float) -> Doubles:
    """Vertices moved to agree with the rendered normals at wavelengths below `wavelength` voxels."""
    gather = NormalGather(vertices, tolerance=3 * cell)
    for index, view in enumerate(spool):
        gather.add(view, spool.normal(index))
    target, trust = gather.normals()
    return follow_normals(vertices, faces, target, trust, wavelength * cell, limit=1.5 * cell)
