"""The stereo of one capture: every photo matched on its own thread, kept on disk as it is done, then confirmed and fused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Array
from gsbake.mvs.carving import Opened, open_hull
from gsbake.mvs.coarse_to_fine import Planes, find_planes
from gsbake.mvs.consistency import agreement
from gsbake.mvs.depth_bounds import depth_bounds, seed_depths
from gsbake.mvs.depth_maps import DepthMap, candidates, confirmed, trusted, z_depth
from gsbake.mvs.fusion import fuse
from gsbake.mvs.point_cloud import StereoCloud
from gsbake.mvs.pyramids import Photo, levels, load_photo
from gsbake.mvs.view_selection import choose

#: Points of the hull that tell which photos see the same surface.
SAMPLES = 2000
#: Tie points are used as samples of the surface from this many on.
LEAST_POINTS = 200
#: Tie points seed pixels up to this share of the photo's width away.
SEED_REACH = 0.08
#: Threads that ask photos about one another: each holds the planes of a dozen.
MOST_ASKING = 6


@dataclass
class StereoRun:
    """State of one run; `parallel` runs a call per photo on the threads and reports progress.

    `step(i, text)` is called in the main thread after each photo and may raise to stop.
    """

    posed: PosedPhotos
    settings: Any
    hull: Hull | None
    seed: int
    threads: int
    keep: Path
    step: Callable[[int, str], None]
    photos: list[list[Photo]] = field(default_factory=list)
    matched: list[list[int]] = field(default_factory=list)
    asked: list[list[int]] = field(default_factory=list)
    shared: list[NDArray[np.float32]] = field(default_factory=list)

    def prepare(self) -> None:
        """Load the photos and choose their neighbours."""
        self.photos = self.parallel(lambda i: levels(load_photo(self.posed, i, self.settings.max_size)), "photos")
        points, normals = self._surface()
        cameras, settings = self.posed.cameras.cameras, self.settings
        self.matched, self.asked = choose(cameras, points, normals, settings.neighbours, settings.consistency_views)

    def _surface(self) -> tuple[Array, Array | None]:
        """Sample points of the object, with normals where they are known."""
        if self.hull is not None:
            return self.hull.surface_points(SAMPLES, self.seed)
        cloud = self.posed.points()
        if cloud is not None and len(cloud[0]) >= LEAST_POINTS:
            inside = cloud[0][np.linalg.norm(cloud[0], axis=1) < 1]
            if len(inside) >= LEAST_POINTS:
                return inside[:: max(1, len(inside) // SAMPLES)], None
        return np.zeros((1, 3)), None

    def parallel(self, call: Callable[[int], Any], text: str, most: int = 64) -> list[Any]:
        """`call(i)` for every photo on at most `most` threads, results in order."""
        count = len(self.posed)
        results: list[Any] = [None] * count
        pool = ThreadPoolExecutor(max(1, min(self.threads, count, most)), thread_name_prefix="gsbake-stereo")
        try:
            waiting: dict[Future[Any], int] = {pool.submit(call, i): i for i in range(count)}
            done = 0
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    results[waiting.pop(future)] = future.result()
                    done += 1
                    self.step(done, text)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
        return results

    def match(self) -> None:
        """Find the planes of every photo that is not on disk yet."""
        self.keep.mkdir(parents=True, exist_ok=True)
        cloud = self.posed.points()
        ties = np.zeros((0, 3)) if cloud is None else cloud[0]

        def one(index: int) -> None:
            target = self._file(index)
            if target.exists():
                return
            sizes = self.photos[index]
            coarse = sizes[0]
            low, high = depth_bounds(coarse.camera, coarse.inside, self.hull)
            seeds = seed_depths(coarse.camera, ties, max(2, round(SEED_REACH * coarse.camera.width)))
            others = [self._at_sizes(j, len(sizes)) for j in self.matched[index]]
            planes = find_planes(sizes, others, (low, high), seeds, self.settings.best_views, self.seed + index)
            partial = target.with_suffix(".tmp.npy")
            np.save(partial, np.concatenate([planes.plane, planes.cost[..., None]], -1))
            partial.replace(target)

        self.parallel(one, "matching")

    def _at_sizes(self, index: int, count: int) -> list[Photo]:
        """Photo `index` at its `count` finest sizes; photos of other proportions may have fewer: then the coarsest repeats halved."""
        sizes = self.photos[index][-count:]
        while len(sizes) < count:
            sizes = [sizes[0].halved(), *sizes]
        return sizes

    def _file(self, index: int) -> Path:
        return self.keep / f"{self.posed.cameras.cameras[index].name}.npy"

    def _planes(self, index: int) -> Planes:
        """Of photo `index`, as views of the file: read only where and when they are looked at."""
        body = np.load(self._file(index), mmap_mode="r")
        return Planes(body[..., :3], body[..., 3])

    def confirm(self) -> list[DepthMap]:
        """Ask the photos about one another twice: about all that match, then about what the first round left.

        `shared` keeps the depths (h, w; 0 = none) of each photo that others agreed with in the first round.
        """
        least = self.settings.min_consistent_views

        def ask(index: int, good: Sequence[NDArray[np.uint8]]) -> Any:
            others = [(self.photos[j][-1].camera, self._planes(j).plane, good[j]) for j in self.asked[index]]
            own = np.ascontiguousarray(self._planes(index).plane)
            return agreement(self.photos[index][-1].camera, own, good[index], others)

        first = self.parallel(lambda i: candidates(self._planes(i).cost), "confirming")

        def again(index: int) -> Any:
            found = ask(index, first)
            shared = z_depth(self.photos[index][-1].camera, self._planes(index).plane, found.agreeing >= least)
            return confirmed(found, least), shared

        answers = self.parallel(again, "confirming", MOST_ASKING)
        second, self.shared = [good for good, _ in answers], [shared for _, shared in answers]

        def last(index: int) -> DepthMap:
            return trusted(self.photos[index][-1].camera, self._planes(index).cost, ask(index, second), least, self.hull)

        return self.parallel(last, "confirming", MOST_ASKING)

    def opened(self) -> Opened | None:
        """The hull without what the shared depths see through; None without a hull. After `confirm`."""
        if self.hull is None:
            return None
        return open_hull(self.hull, [sizes[-1].camera for sizes in self.photos], self.shared)

    def points(self, maps: Sequence[DepthMap]) -> StereoCloud:
        """Fuse the depth maps."""
        size = self.settings.max_size
        return fuse(maps, self.asked, lambda i: self.posed.view(i, size).rgb, lambda i: self.step(i + 1, "fusing"))
