"""Refinement of the dense mesh by masks and photos, on a coarser mesh whose displacements move it.

It is done at the size of photos that the profile names; then, where their patches confirm the surface and stereo matched larger photos,
again by the patches of those.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.geometry.cameras import Camera
from gsbake.meshing.decimator_choice import Decimator
from gsbake.meshing.decimators import remesh
from gsbake.meshing.refinement.photometric_measure import PatchTargets, PhotometricViews
from gsbake.monitor import Monitor
from gsbake.mvs.depth_maps import read_depth
from gsbake.mvs.pyramids import Photo, load_photo
from gsbake.shape_refinement.refine import RefinementOptions, pixel_size, proxy_edge, refine_shape
from gsbake.shape_refinement.samples import load_photos
from gsbake.shape_refinement.surface import Surface
from gsbake.shape_refinement.transfer import transfer_displacements

Doubles = NDArray[np.float64]
Faces = NDArray[np.int32]

#: Memory for photos whose patches are compared, in bytes.
PHOTO_CACHE_BYTES = 1 << 29
#: Most photos that the shape is refined with.
MAX_PHOTOS = 96
#: Share of the surface that patches of photos must confirm for the second refinement, and its options: patches alone.
MIN_CONFIRMED = 0.2
PATCHES_ONLY = RefinementOptions(first_steps=2, confirmed=0.0)


@dataclass(frozen=True)
class ShapeRefinement:
    """One refinement by the photos `usable`, at most MAX_PHOTOS of them. A depth of the folder `stereo` within `tolerance` (unit frame) of
    the mesh confirms it; the coarser mesh has at most `most` vertices and is made by `decimator`."""

    photos: FullPhotos
    usable: Sequence[int]
    stereo: Path | None
    tolerance: float
    most: int
    decimator: Decimator
    seed: int
    threads: int
    monitor: Monitor

    def refine(self, vertices: Doubles, faces: Faces, size: int, finer: int) -> tuple[Doubles, dict[str, float]]:
        """Vertices (v, 3) refined in photos with a longer side of `size`, then of `finer` pixels, if that is more; results by name."""
        vertices, evidence, figures = self._refine_at(size, vertices, faces, RefinementOptions())
        if finer > size and figures.get("confirmed", 0.0) >= MIN_CONFIRMED:
            vertices, more, again = self._refine_at(finer, vertices, faces, PATCHES_ONLY)
            evidence = f"{evidence}; then in photos of {finer} px: {more}"
            figures = figures | {f"finer_{name}": value for name, value in again.items()}
        if figures:
            self.monitor.decide("shape refinement", f"mean displacement {figures['moved_pixels']:.2f} px", evidence)
        return vertices, {f"refinement_{name}": value for name, value in figures.items()}

    def _refine_at(
        self, size: int, vertices: Doubles, faces: Faces, options: RefinementOptions
    ) -> tuple[Doubles, str, dict[str, float]]:  # fmt: skip
        """The refined vertices, the evidence, and figures; empty ones where no coarser mesh is left."""
        posed, monitor, chosen = self.photos.posed, self.monitor, evenly(self.usable, MAX_PHOTOS)
        cameras = [self.photos.camera(index, size) for index in chosen]
        pixel = pixel_size(vertices, cameras)
        coarse, coarse_faces = remesh(vertices, faces, proxy_edge(vertices, faces, pixel, self.most), self.most, self.decimator)
        if len(coarse_faces) == 0:
            return vertices, "", {}
        result = refine_shape(
            coarse, coarse_faces, lambda blur: load_photos(posed, chosen, size, blur, monitor.check_stop),
            (lambda: (posed.mask(index) for index in chosen)) if posed.has_masks else None,
            pixel, self._patches(size, chosen, cameras), options, seed=self.seed, threads=self.threads, monitor=monitor,
        )  # fmt: skip
        before, fine = Surface(len(coarse), coarse_faces), Surface(len(vertices), faces)
        move = transfer_displacements(vertices, fine.normals(vertices), coarse, before.normals(coarse), result.vertices)
        return vertices + move, _evidence(len(coarse), len(chosen), result.figures), result.figures

    def _patches(self, size: int, chosen: Sequence[int], cameras: list[Camera]) -> PatchTargets | None:
        """What compares patches of the `chosen` photos where stereo confirmed depths; None where it did nowhere."""
        files = [] if self.stereo is None else [self.stereo / "depth" / f"{camera.name}.npz" for camera in cameras]
        if not any(file.exists() for file in files):
            return None

        @lru_cache(maxsize=max(8, PHOTO_CACHE_BYTES // (2 * max(c.width * c.height for c in cameras))))
        def photo(index: int) -> Photo:
            self.monitor.check_stop()
            return load_photo(self.photos, chosen[index], size)

        return PatchTargets(
            PhotometricViews(cameras, photo, lambda index: read_depth(files[index]) if files[index].exists() else None, self.tolerance),
            self.threads,
        )


def _evidence(vertices: int, photos: int, figures: dict[str, float]) -> str:
    """What the figures of a refinement say."""
    evidence = f"{vertices} vertices in {photos} photos; {100 * figures['confirmed']:.0f} % of the surface match in most photos"
    if "explained" in figures:
        evidence += f"; reflections explain {100 * figures['explained']:.0f} % of what changes between photos"
    elif "predicted" in figures:
        evidence += f"; no reflections: fitted to other photos they predict {100 * figures['predicted']:.0f} % of what changes"
    if "contour_after" in figures:
        evidence += f"; contours {figures['contour_before']:+.2f} px from the masks before, {figures['contour_after']:+.2f} px after"
    return evidence


def evenly(indices: Sequence[int], most: int) -> list[int]:
    """At most `most` of the indices, evenly spread."""
    count = min(len(indices), most)
    return [indices[k * len(indices) // count] for k in range(count)]
