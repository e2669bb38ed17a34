"""Stereo of one capture: parallel matching per photo with results on disk, consistency checks, fusion and hull carving."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.posed_photos import Bytes, PosedPhotos
from gsbake.checkpoint import is_sealed, seal_file
from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.carving import CarvedHull, carve_hull
from gsbake.mvs.coarse_to_fine import Planes, find_planes
from gsbake.mvs.consistency import check_consistency
from gsbake.mvs.depth_bounds import depth_bounds, seed_depths
from gsbake.mvs.depth_maps import DepthMap, consistent_pixels, filter_depth_map, matched_pixels, z_depth
from gsbake.mvs.fusion import fuse
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.mvs.pyramids import Photo, image_pyramid, load_photo
from gsbake.mvs.view_selection import select_views

#: Number of surface samples for view selection.
SURFACE_SAMPLES = 2000
#: Minimum number of tie points that serve as surface samples.
MIN_TIE_POINTS = 200
#: Radius around a tie point, as a share of the photo's width, in which pixels are initialised with its depth.
SEED_REACH = 0.08
#: Threads of the consistency check: each holds the planes of a dozen photos in memory.
MAX_CONSISTENCY_THREADS = 6


@dataclass
class StereoRun:
    """State of one run. `size` is the longer side of the matched photos in pixels; `settings` is the section [stereo]; matched planes go
    into the folder `planes_folder`.

    `report(i, text)` is called in the main thread after each photo and may raise to stop. Per photo: the camera of the largest size and its
    number of `pixels` inside, the image pyramid (until all are matched), the source views, the views of the consistency check, and, where
    there is a hull to carve, the depths (h, w; 0 = none) that were consistent in the first check.
    """

    photos: FullPhotos
    size: int
    settings: Any
    hull: Hull | None
    seed: int
    threads: int
    planes_folder: Path
    report: Callable[[int, str], None]
    cameras: list[Camera] = field(default_factory=list)
    pixels: list[int] = field(default_factory=list)
    pyramids: list[list[Photo]] = field(default_factory=list)
    sources: list[list[int]] = field(default_factory=list)
    consistency_views: list[list[int]] = field(default_factory=list)
    consistent_depths: list[NDArray[np.float32]] = field(default_factory=list)

    @property
    def posed(self) -> PosedPhotos:
        """The working photos."""
        return self.photos.posed

    def prepare(self) -> None:
        """Load the photos and select their views."""
        self.pyramids = self.parallel(lambda i: image_pyramid(load_photo(self.photos, i, self.size)), "photos")
        self.cameras = [sizes[-1].camera for sizes in self.pyramids]
        self.pixels = [int(sizes[-1].inside.sum()) for sizes in self.pyramids]
        points, normals = self._surface_samples()
        cameras, settings = self.posed.cameras.cameras, self.settings
        self.sources, self.consistency_views = select_views(cameras, points, normals, settings.neighbours, settings.consistency_views)

    def _surface_samples(self) -> tuple[Array, Array | None]:
        """Sample points (n, 3) of the surface, with normals where they are known."""
        if self.hull is not None:
            return self.hull.surface_points(SURFACE_SAMPLES, self.seed)
        cloud = self.posed.points()
        if cloud is not None and len(cloud[0]) >= MIN_TIE_POINTS:
            inside = cloud[0][np.linalg.norm(cloud[0], axis=1) < 1]
            if len(inside) >= MIN_TIE_POINTS:
                return inside[:: max(1, len(inside) // SURFACE_SAMPLES)], None
        return np.zeros((1, 3)), None

    def parallel(self, call: Callable[[int], Any], text: str, max_threads: int = 64) -> list[Any]:
        """`call(i)` for every photo on at most `max_threads` threads, results in order."""
        count = len(self.posed)
        results: list[Any] = [None] * count
        pool = ThreadPoolExecutor(max(1, min(self.threads, count, max_threads)), thread_name_prefix="gsbake-stereo")
        try:
            waiting: dict[Future[Any], int] = {pool.submit(call, i): i for i in range(count)}
            done = 0
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    results[waiting.pop(future)] = future.result()
                    done += 1
                    self.report(done, text)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
        return results

    def match(self) -> None:
        """Match every photo whose planes are not on disk yet."""
        self.planes_folder.mkdir(parents=True, exist_ok=True)
        cloud = self.posed.points()
        ties = np.zeros((0, 3)) if cloud is None else cloud[0]

        def match_photo(index: int) -> None:
            target = self._planes_path(index)
            if is_sealed(target):
                return
            sizes = self.pyramids[index]
            coarse = sizes[0]
            low, high = depth_bounds(coarse.camera, coarse.inside, self.hull)
            seeds = seed_depths(coarse.camera, ties, max(2, round(SEED_REACH * coarse.camera.width)))
            others = [self._pyramid(j, len(sizes)) for j in self.sources[index]]
            planes = find_planes(sizes, others, (low, high), seeds, self.settings.best_views, self.seed + index)
            partial = target.with_suffix(".tmp.npy")
            np.save(partial, np.concatenate([planes.plane, planes.cost[..., None]], -1))
            partial.replace(target)
            seal_file(target)

        self.parallel(match_photo, "matching")
        self.pyramids = []  # they take gigabytes for hundreds of photos

    def _pyramid(self, index: int, count: int) -> list[Photo]:
        """Photo `index` at `count` sizes; where its own pyramid is shorter (other proportions), the coarsest size is halved further."""
        sizes = self.pyramids[index][-count:]
        while len(sizes) < count:
            sizes = [sizes[0].halved(), *sizes]
        return sizes

    def _planes_path(self, index: int) -> Path:
        return self.planes_folder / f"{self.posed.cameras.cameras[index].name}.npy"

    def _planes(self, index: int) -> Planes:
        """Planes of photo `index`, memory-mapped."""
        body = np.load(self._planes_path(index), mmap_mode="r")
        return Planes(body[..., :3], body[..., 3])

    def filter_depths(self) -> list[DepthMap]:
        """Check consistency twice: of all matched pixels, then of those that passed the first check. Fills `consistent_depths`."""
        min_views = self.settings.min_consistent_views

        def check(index: int, valid: Sequence[NDArray[np.uint8]]) -> Any:
            others = [(self.cameras[j], self._planes(j).plane, valid[j]) for j in self.consistency_views[index]]
            own = np.ascontiguousarray(self._planes(index).plane)
            return check_consistency(self.cameras[index], own, valid[index], others)

        matched = self.parallel(lambda i: matched_pixels(self._planes(i).cost), "consistency")

        def first_check(index: int) -> Any:
            found = check(index, matched)
            kept = found.consistent >= min_views
            depth = None if self.hull is None else z_depth(self.cameras[index], self._planes(index).plane, kept)
            return consistent_pixels(found, min_views), depth

        checked = self.parallel(first_check, "consistency", MAX_CONSISTENCY_THREADS)
        consistent = [pixels for pixels, _ in checked]
        self.consistent_depths = [depth for _, depth in checked if depth is not None]

        def final_check(index: int) -> DepthMap:
            camera, cost = self.cameras[index], self._planes(index).cost
            return filter_depth_map(camera, cost, check(index, consistent), min_views, self.hull)

        return self.parallel(final_check, "consistency", MAX_CONSISTENCY_THREADS)

    def carved_hull(self, softness: NDArray[np.float32]) -> CarvedHull:
        """The hull carved by `consistent_depths`; `softness` as from `surface_softness`. Call after `filter_depths`.

        Raises ValueError without a hull.
        """
        if self.hull is None:
            raise ValueError("there is no hull")
        return carve_hull(self.hull, self.cameras, self.consistent_depths, softness)

    def fuse(self, maps: Sequence[DepthMap]) -> StereoCloud:
        """Fuse the depth maps."""
        return fuse(maps, self.consistency_views, self._colours, lambda i: self.report(i + 1, "fusing"))

    def _colours(self, index: int) -> Bytes:
        """The working photo (h, w, 3) at the size of the matched one."""
        camera, rgb = self.cameras[index], self.posed.view(index, self.size).rgb
        size = camera.width, camera.height
        return rgb if rgb.shape[1::-1] == size else np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR), np.uint8)
