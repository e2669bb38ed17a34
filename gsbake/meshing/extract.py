"""From trained surfels to a mesh: rendered depth maps, one distance field, marching cubes, clean-up, refinement, decimation."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.photos.roles import test_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Mesh
from gsbake.errors import BadInputError
from gsbake.geometry.ply import write_mesh
from gsbake.meshing import cleanup
from gsbake.meshing.decimation import decimate_to_error_bound
from gsbake.meshing.decimator_choice import resolve_decimator
from gsbake.meshing.depth_cache import DepthViewCache
from gsbake.meshing.depth_views import DepthView, depth_noise
from gsbake.meshing.refinement.normal_filter import denoise
from gsbake.meshing.refinement.normals import NormalAccumulator, integrate_normals
from gsbake.meshing.refinement.shape import ShapeRefinement
from gsbake.meshing.repair import close_holes, repair
from gsbake.meshing.resolution import Resolution, choose_resolution, pixel_footprint
from gsbake.meshing.stereo_depth import merge_stereo_depth
from gsbake.meshing.support_plane import SupportPlane, find_support_plane, remove_background_components
from gsbake.meshing.tsdf import SparseTsdf
from gsbake.meshing.untangling import untangle
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip, skips
from gsbake.mvs.depth_maps import read_depth
from gsbake.surfels.field import Field
from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.registry import load_field
from gsbake.surfels.fields.samples import SamplesField
from gsbake.surfels.oriented_points import BALL_RADIUS, OrientedPoints, oriented_points
from gsbake.surfels.renderer import SurfelRenderer
from gsbake.surfels.spacing import surfel_spacing

Doubles = NDArray[np.float64]
Faces = NDArray[np.int32]

#: Minimum and maximum truncation distance in voxels; between them it is three times the depth noise.
TRUNCATION_CELLS = (4.0, 10.0)
#: Maximum difference in voxels at which a stereo depth replaces a rendered one.
STEREO_TOLERANCE = 3.0
#: Minimum extent of the surfels in the unit frame.
MIN_EXTENT = 1e-9
#: Maximum boundary edges of a hole that is filled after meshing; larger ones are openings.
MAX_HOLE_EDGES = 400


@dataclass(frozen=True)
class MeshOptions:
    """Settings of mesh extraction; `train_size` and `stereo_size` are the longer sides in pixels of the photos in training and stereo,
    which matches larger photos at `stereo_scale` of their size, `empty_cells` is the rule of [skip], `projected_depth` that of [surfels],
    `max_triangles` the limit of the exported asset; every `holdout`-th photo is kept out."""

    mesh: Mesh = Mesh()
    train_size: int = 512
    stereo_size: int = 800
    stereo_scale: float = 0.3
    empty_cells: Rule = "auto"
    projected_depth: bool = False
    max_triangles: int = 100_000
    holdout: int = 8

    @property
    def max_faces(self) -> int:
        """Maximum faces of the low-poly mesh under the error bound."""
        return max(self.mesh.faces, self.mesh.max_faces or min(4 * self.mesh.faces, self.max_triangles))


def extract_mesh(
    poses: Path,
    surfels: Path,
    out: Path,
    options: MeshOptions | None = None,
    *,
    ingest: Path | None = None,
    stereo: Path | None = None,
    seed: int = 0,
    threads: int = 2,
    device: str = "cpu",
    scratch: Path | None = None,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Mesh the surfels of the folder `surfels`; write `dense.ply` and `mesh.ply` (unit frame) into `out` and return the results.

    `ingest` has the photos at full size; `stereo` is the folder that `run_stereo` wrote; temporary depth maps are written below `scratch`.
    Raises BadInputError when the surfels contain no surface.
    """
    with FullPhotos(ingest, poses, surfels) as photos, tempfile.TemporaryDirectory(dir=scratch, prefix="depth-") as folder:
        run = _Extraction(photos, surfels, stereo, out, options or MeshOptions(), seed, threads, device, monitor)
        return run.extract(DepthViewCache(Path(folder)))


@dataclass
class _Extraction:
    """Inputs and settings of one mesh extraction."""

    photos: FullPhotos
    trained: Path
    stereo: Path | None
    out: Path
    options: MeshOptions
    seed: int
    threads: int
    device: str
    monitor: Monitor

    @property
    def posed(self) -> PosedPhotos:
        """The working photos."""
        return self.photos.posed

    @cached_property
    def renderer(self) -> SurfelRenderer:
        """Renderer of the trained surfels."""
        return SurfelRenderer.load(self.trained, self.device)

    @cached_property
    def trained_field(self) -> Field:
        """The field that the surfels were trained with."""
        return load_field(self.trained, self.renderer.surfels)

    def extract(self, cache: DepthViewCache) -> dict[str, Any]:
        """Run all steps; the results for the manifest."""
        samples = self._samples()
        lower, upper, resolution = self._choose_resolution(samples.points)
        with self.monitor.part("depth"):
            self._render(cache, resolution)
        noise = _noise(cache)
        cells = min(max(3 * noise / resolution.cell, TRUNCATION_CELLS[0]), TRUNCATION_CELLS[1])
        evidence = f"median depth difference between neighbouring views {noise / resolution.cell:.2f} voxels"
        self.monitor.decide("truncation", f"{cells:.1f} voxels", evidence)
        support = self._support(samples)
        field = self._field(cache, lower, upper, resolution, cells * resolution.cell, support)
        with self.monitor.part("marching"):
            vertices, faces = field.mesh(close=self.options.mesh.holes == "close")
        del field
        if len(faces) == 0:
            raise BadInputError(
                "mesh: the trained surfels contain no surface inside the unit sphere; see the training figures in the report, "
                "provide masks, or train longer (train.iterations)."
            )
        with self.monitor.part("clean"):
            vertices, faces, dropped = self._clean(vertices, faces, cache, resolution.cell, support)
        start = vertices
        with self.monitor.part("shape"):
            vertices, refinement = self._refine_shape(vertices, faces, resolution.cell)
        with self.monitor.part("denoising"):
            vertices = denoise(vertices, faces, self.options.mesh.denoising_iterations)
        if (region := self.posed.region) is not None:
            vertices = region.clamped(vertices)  # silhouettes draw the faces of the cut outwards
        with self.monitor.part("untangling"):
            vertices, faces = untangle(vertices, faces, start)
            vertices, faces, cut_off = cleanup.remove_small_components(vertices, faces, self.options.mesh.min_component)
            dropped += cut_off
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
            **refinement,
        }

    def _samples(self) -> OrientedPoints:
        """The surfels inside the region as oriented points; raises BadInputError below ten."""
        samples = oriented_points(self.renderer.surfels)
        if (region := self.posed.region) is not None:
            inside = region.contains(samples.points)
            samples = OrientedPoints(samples.points[inside], samples.normals[inside], samples.weights[inside])
        if len(samples.points) < 10:
            raise BadInputError(
                "mesh: fewer than ten surfels lie inside the unit sphere and the region; training failed, see its figures in the report."
            )
        return samples

    def _choose_resolution(self, points: Doubles) -> tuple[Doubles, Doubles, Resolution]:
        """The object's padded bounding box, and the voxel size with its reason."""
        lower, upper = points.min(0), points.max(0)
        cameras = [camera.downscaled_to(self.options.train_size) for camera in self.posed.cameras.cameras]
        settings = self.options.mesh
        footprint = pixel_footprint(cameras, (lower + upper) / 2)
        longest = float((upper - lower).max())
        if longest < MIN_EXTENT:
            raise BadInputError("mesh: all surfels lie in one point; training failed, see its figures in the report.")
        resolution = choose_resolution(longest, surfel_spacing(points), footprint, settings.resolution, settings.max_resolution)
        self.monitor.decide("field resolution", f"{resolution.cells} voxels of {resolution.cell:.4g}", resolution.reason)
        pad = 16 * resolution.cell  # for the truncation distance and the boundary layers of the coarse lattice
        return np.maximum(lower - pad, -BALL_RADIUS - pad), np.minimum(upper + pad, BALL_RADIUS + pad), resolution

    def _render(self, cache: DepthViewCache, resolution: Resolution) -> None:
        """Render depth and normals at every photo's pose into the cache; stereo depths replace rendered ones that agree."""
        shares: list[float] = []
        for index in range(len(self.posed)):
            self.monitor.check_stop()
            photo = self.posed.view(index, self.options.train_size)
            buffers = self.renderer.gbuffer(photo.camera, self.options.projected_depth)
            view = DepthView.from_gbuffer(photo.camera, buffers, photo.mask, TRUNCATION_CELLS[0] * resolution.cell)
            stereo_file = None if self.stereo is None else self.stereo / "depth" / f"{photo.camera.name}.npz"
            if stereo_file is not None and stereo_file.exists():
                view, share = merge_stereo_depth(view, *read_depth(stereo_file), STEREO_TOLERANCE * resolution.cell)
                shares.append(share)
            cache.append(view, buffers["normal"])
            self.monitor.progress(index + 1, len(self.posed), "depth maps")
        if shares:
            share = 100 * sum(shares) / len(shares)
            self.monitor.decide("depth maps", f"{share:.0f} % from stereo", f"where both agree to {STEREO_TOLERANCE:g} voxels")

    def _support(self, samples: OrientedPoints) -> SupportPlane | None:
        """The support plane to remove; None with masks or with `mesh.support_plane` = keep."""
        if self.posed.has_masks or self.options.mesh.support_plane == "keep":
            return None
        centres = np.stack([camera.centre for camera in self.posed.cameras.cameras])
        found, evidence = find_support_plane(samples.points, samples.normals, samples.weights, centres, self.seed)
        self.monitor.decide("support plane", "part of the object" if found is None else "removed", evidence)
        return found

    def _field(
        self, cache: DepthViewCache, lower: Doubles, upper: Doubles, resolution: Resolution, truncation: float,
        support: SupportPlane | None,
    ) -> SparseTsdf:  # fmt: skip
        """The distance field, from depth maps or from the surfels' SDF samples."""
        monitor, empty_outside = self.monitor, self.posed.has_masks or support is not None
        field = SparseTsdf(
            lower, upper, resolution.cell, truncation, ball=BALL_RADIUS, empty_outside=empty_outside, support=support,
            region=self.posed.region,
        )  # fmt: skip
        source = self.options.mesh.field
        trained = self.trained_field if source == "trained" else SamplesField(self.renderer.surfels, None)
        with monitor.part("survey"):
            if isinstance(trained, ContinuousField):
                field.evaluate_coarse(trained.mesh)
            else:
                for done, view in enumerate(cache):
                    monitor.check_stop()
                    field.fuse_coarse(view)
                    monitor.progress(done + 1, 2 * len(cache), "fusing")
        rule = self.options.empty_cells
        with monitor.part("filling"):
            field.allocate(all_blocks=not skips(rule, holds=True))
        with monitor.part("fusion"):
            if source != "tsdf":
                field.set_field(trained.mesh(field.lattice, truncation))
            else:
                for done, view in enumerate(cache):
                    monitor.check_stop()
                    field.integrate(view)
                    monitor.progress(len(cache) + done + 1, 2 * len(cache), "fusing")
        count = np.prod(field.lattice.samples) / 1e6
        cells = f"{100 * field.near_share:.1f} % of the grid's {count:.1f} million voxels lie near the surface"
        evidence = f"{cells}; those filled take {field.nbytes / 1e6:.0f} MB"
        decide_skip(monitor, "empty_cells", rule, True, evidence, "empty voxels skipped", "all voxels filled")
        return field

    def _clean(
        self, vertices: Doubles, faces: Faces, cache: DepthViewCache, cell: float, support: SupportPlane | None
    ) -> tuple[Doubles, Faces, int]:
        """Remove small and background components, integrate rendered normals, smooth, untangle, close holes; also the number removed."""
        settings, background = self.options.mesh, 0
        if support is not None:
            vertices, faces, background = remove_background_components(vertices, faces, BALL_RADIUS - 3 * cell)
            vertices = support.snap_to_plane(vertices, cell)
        vertices, faces, dropped = cleanup.remove_small_components(vertices, faces, settings.min_component)
        start = vertices
        if settings.normal_wavelength > 0:
            if settings.normals == "field":
                vertices = self._integrate_gradients(vertices, faces, cell)
            else:
                vertices = _integrate_normals(cache, vertices, faces, settings.normal_wavelength, cell)
        vertices = cleanup.smooth(vertices, faces, settings.smoothing_iterations)
        if cleanup.topology(vertices, faces).watertight:
            vertices, faces = untangle(vertices, faces, start)
        else:
            vertices, faces = repair(vertices, faces)
            if settings.holes == "close":
                vertices, faces = close_holes(vertices, faces, MAX_HOLE_EDGES)
            vertices, faces = untangle(vertices, faces)
        return vertices, faces, dropped + background

    def _integrate_gradients(self, vertices: Doubles, faces: Faces, cell: float) -> Doubles:
        """Refine the vertices against the gradient of the trained field at wavelengths below `mesh.normal_wavelength` voxels."""
        with torch.no_grad():
            points = torch.from_numpy(vertices.astype(np.float32))
            gradient = torch.cat([self.trained_field.gradient(part) for part in points.split(1 << 16)]).numpy().astype(float)
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        normals, confidence = gradient / np.maximum(length, 1e-9), (length[:, 0] > 0.1).astype(float)
        wavelength = self.options.mesh.normal_wavelength * cell
        return integrate_normals(vertices, faces, normals, confidence, wavelength, max_displacement=1.5 * cell)

    def _refine_shape(self, vertices: Doubles, faces: Faces, cell: float) -> tuple[Doubles, dict[str, float]]:
        """The vertices refined by masks and photos (`ShapeRefinement`); also results for the manifest."""
        options, posed = self.options, self.posed
        if len(faces) == 0:
            return vertices, {}
        if not options.mesh.refinement_vertices:
            self.monitor.decide("shape refinement", "skipped", "set by the profile")
            return vertices, {}
        test = set(test_photos(len(posed), options.holdout))
        run = ShapeRefinement(
            self.photos, [index for index in range(len(posed)) if index not in test], self.stereo, STEREO_TOLERANCE * cell,
            options.mesh.refinement_vertices, resolve_decimator(options.mesh.decimator), self.seed, self.threads, self.monitor,
        )  # fmt: skip
        return run.refine(vertices, faces, options.stereo_size, self.photos.size_of(options.stereo_size, options.stereo_scale))

    def _decimate(self, vertices: Doubles, faces: Faces, cell: float) -> dict[str, Any]:
        """Decimate and write the low-poly mesh; its results for the manifest."""
        settings, monitor = self.options.mesh, self.monitor
        decimator = resolve_decimator(settings.decimator)
        result = decimate_to_error_bound(
            vertices, faces, settings.faces, self.options.max_faces, settings.max_error * cell, decimator, monitor.check_stop
        )
        if len(result.faces) == 0:
            raise BadInputError(f"mesh: nothing is left of the surface at {settings.faces} faces; raise mesh.faces or mesh.resolution.")
        write_mesh(self.out / "mesh.ply", result.vertices, result.faces)
        deviation, bound = result.deviation.quantile / cell, f"bound {settings.max_error:g}" if settings.max_error else "no bound"
        choice = f"{len(result.faces)} faces" + (f" instead of {settings.faces}" if result.retries else "")
        monitor.decide("decimation", choice, f"{decimator}; deviation from the dense mesh {deviation:.2f} voxels ({bound})")
        if 0 < settings.max_error < deviation:
            monitor.warn(f"mesh: decimation to {len(result.faces)} faces deviates by {deviation:.2f} voxels; raise mesh.faces.")
        return {
            "vertices": len(result.vertices),
            "faces": len(result.faces),
            "components": result.topology.components,
            "watertight": result.topology.watertight,
            "decimator": decimator,
            "border_edges": result.topology.border_edges,
            "decimation_deviation_cells": deviation,
            "decimation_error_cells": result.deviation.maximum / cell,
        }


def _noise(cache: DepthViewCache) -> float:
    """Median depth difference (unit frame) of neighbouring views; 0 when no two views overlap."""
    directions = np.stack([cache.view(index).camera.view_direction for index in range(len(cache))])
    differences = []
    for index in range(0, len(cache), max(1, len(cache) // 12)):
        cosine = directions @ directions[index]
        cosine[index] = -2
        difference = depth_noise(cache.view(index), cache.view(int(cosine.argmax())))
        if difference is not None:
            differences.append(difference)
    return float(np.median(differences)) if differences else 0.0


def _integrate_normals(cache: DepthViewCache, vertices: Doubles, faces: Faces, wavelength: float, cell: float) -> Doubles:
    """Refine the vertices against rendered normals at wavelengths below `wavelength` voxels."""
    accumulator = NormalAccumulator(vertices, tolerance=3 * cell)
    for index, view in enumerate(cache):
        accumulator.add(view, cache.normal(index))
    normals, confidence = accumulator.normals()
    return integrate_normals(vertices, faces, normals, confidence, wavelength * cell, max_displacement=1.5 * cell)
