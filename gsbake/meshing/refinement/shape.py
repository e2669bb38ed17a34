"""Refinement of the dense mesh by masks and photos, on a coarser mesh whose displacements move it.

It is done at the size of photos that the profile names, by their patches. Where stereo matched larger photos and confirmed the surface, it
is done at the size of those, by stereo's depths: patches of the surface's planes are less exact.
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
from gsbake.meshing.refinement.stereo_targets import StereoTargets
from gsbake.monitor import Monitor
from gsbake.mvs.depth_maps import read_depth
from gsbake.mvs.pyramids import Photo, load_photo
from gsbake.shape_refinement.refine import RefinementOptions, pixel_size, proxy_edge, refine_shape
from gsbake.shape_refinement.samples import load_photos
from gsbake.shape_refinement.surface import Surface
from gsbake.shape_refinement.transfer import transfer_displacements

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Faces = NDArray[np.int32]

#: Memory for photos whose patches are compared, in bytes.
PHOTO_CACHE_BYTES = 1 << 29
#: Most photos that the shape is refined with.
MAX_PHOTOS = 96
#: Share of the surface that stereo must confirm in larger photos, and the options of refinement by it: targets alone.
MIN_CONFIRMED = 0.2
TARGETS_ONLY = RefinementOptions(confirmed=0.0)


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
        """Vertices (v, 3) refined in photos with a longer side of `size`, or of `finer` pixels, if that is more; results by name."""
        moved, evidence, figures = vertices, "", dict[str, float]()
        if finer > size:
            moved, evidence, figures = self._refine_at(finer, vertices, faces, by_stereo=True)
        if figures.get("confirmed", 0.0) < MIN_CONFIRMED:
            moved, evidence, figures = self._refine_at(size, vertices, faces, by_stereo=False)
        if figures:
            self.monitor.decide("shape refinement", f"mean displacement {figures['moved_pixels']:.2f} px", evidence)
        return moved, {f"refinement_{name}": value for name, value in figures.items()}

    def _refine_at(self, size: int, vertices: Doubles, faces: Faces, by_stereo: bool) -> tuple[Doubles, str, dict[str, float]]:
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
            pixel, self._targets(size, chosen, cameras, pixel, by_stereo),
            TARGETS_ONLY if by_stereo else None, seed=self.seed, threads=self.threads, monitor=monitor,
        )  # fmt: skip
        before, fine = Surface(len(coarse), coarse_faces), Surface(len(vertices), faces)
        move = transfer_displacements(vertices, fine.normals(vertices), coarse, before.normals(coarse), result.vertices)
        where = f"photos of {size} px by the depths of stereo" if by_stereo else "photos"
        return vertices + move, _evidence(f"{len(coarse)} vertices in {len(chosen)} {where}", result.figures), result.figures

    def _targets(
        self, size: int, chosen: Sequence[int], cameras: list[Camera], pixel: float, by_stereo: bool
    ) -> StereoTargets | PatchTargets | None:
        """What measures the way to stereo's depths, or compares patches of the `chosen` photos there; None where it found no depth."""
        files = [] if self.stereo is None else [self.stereo / "depth" / f"{camera.name}.npz" for camera in cameras]
        if not any(file.exists() for file in files):
            return None

        def depth(index: int) -> tuple[Floats, Floats] | None:
            self.monitor.check_stop()
            return read_depth(files[index]) if files[index].exists() else None

        if by_stereo:
            return StereoTargets(cameras, depth, self.tolerance, pixel, self.threads)

        @lru_cache(maxsize=max(8, PHOTO_CACHE_BYTES // (2 * max(c.width * c.height for c in cameras))))
        def photo(index: int) -> Photo:
            self.monitor.check_stop()
            return load_photo(self.photos, chosen[index], size)

        return PatchTargets(PhotometricViews(cameras, photo, depth, self.tolerance), self.threads)


def _evidence(what: str, figures: dict[str, float]) -> str:
    """What the figures of a refinement of `what` say."""
    evidence = f"{what}; {100 * figures['confirmed']:.0f} % of the surface match in most photos"
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
