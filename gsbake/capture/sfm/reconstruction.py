"""Structure from motion with COLMAP (Schönberger, Frahm, *Structure-from-Motion Revisited*, CVPR 2016), as the steps of one database.

Features (SIFT), pairs, matches, mapping in two passes: strict thresholds build a sound core; if photos are missing they are matched
with all others and registered to it under weaker thresholds. Runs inside the process of `solve_worker`.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.sfm import pairs as pairing
from gsbake.capture.sfm.colmap import pycolmap

Tick = Callable[[str, int, int], None]

#: Thresholds of the second pass: inliers and their share that register a photo (COLMAP's own: 30 and 0.25).
WEAK_INLIERS, WEAK_SHARE = 15, 0.15
#: Largest features per photo in the ranking of pairs.
RANKING_FEATURES = 256
#: Features per photo with which the finest octave is left out, and the share of photos that may then fail before it is added after all.
ENOUGH, POOR = 1500, 0.05
#: Pairs matched between two lines in COLMAP's log, by which `solve` tells the progress.
BLOCK = 64


@dataclass(frozen=True)
class Lens:
    """Photos taken with one camera: their names, their size in pixels, and its focal length in pixels where it is roughly known."""

    names: tuple[str, ...]
    width: int
    height: int
    focal: float | None = None


@dataclass
class Solver:
    """One SfM run: photos `folder/<name>.png`, masks `mask_folder/<name>.png.png`, database and models in `work`."""

    folder: Path
    work: Path
    lenses: Sequence[Lens]
    mask_folder: Path | None
    max_features: int
    peak_threshold: float
    max_size: int
    fine: bool | str
    threads: int
    seed: int
    tick: Tick
    seconds: dict[str, float] = field(default_factory=dict)
    upsampled: bool = False

    @property
    def database(self) -> Path:
        """The COLMAP database."""
        return self.work / "database.db"

    @property
    def names(self) -> list[str]:
        """All photos in order."""
        return sorted(name for lens in self.lenses for name in lens.names)

    @contextmanager
    def _timed(self, part: str, total: int) -> Iterator[None]:
        """Announce a part and time it."""
        start = time.perf_counter()
        self.tick(part, 0, total)
        try:
            yield
        finally:
            self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start

    def _extraction(self) -> Any:
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = self.threads
        options.use_gpu = False
        options.max_image_size = self.max_size
        options.sift.max_num_features = self.max_features
        options.sift.peak_threshold = self.peak_threshold
        options.sift.first_octave = -1 if self.upsampled else 0
        return options

    def _needs_fine(self) -> bool:
        """Whether a few photos show that features of the finest octave are needed."""
        names = self.names
        sample = [names[i] for i in sorted({0, len(names) // 2, len(names) - 1})]
        base_file = self.work / "probe.db"
        self.upsampled = False
        pycolmap.extract_features(
            str(base_file),
            str(self.folder),
            [f"{name}.png" for name in sample],
            pycolmap.CameraMode.PER_IMAGE,
            self._reader(),
            self._extraction(),
            pycolmap.Device.cpu,
        )
        with closing(pycolmap.Database.open(str(base_file))) as base:
            counts = [base.num_keypoints_for_image(image.image_id) for image in base.read_all_images()]
        return not counts or float(np.median(counts)) < min(ENOUGH, 0.5 * self.max_features)

    def _reader(self) -> Any:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        if self.mask_folder is not None:
            reader.mask_path = str(self.mask_folder)
        return reader

    def features(self) -> None:
        """Find SIFT features in all photos; kept in the database, so that an interrupted run does not repeat it.

        The finest octave (photos enlarged twice) costs five times as much and holds most features but not the best ones; in "auto" it is
        left out where the others are enough.
        """
        marker = self.work / "features.done"
        if marker.exists():
            self.upsampled = marker.read_text() == "fine"
            return
        self._clear()
        with self._timed("features", len(self.names)):
            self.upsampled = self._needs_fine() if self.fine == "auto" else bool(self.fine)
            options = self._extraction()
            for lens in self.lenses:
                files = [f"{name}.png" for name in lens.names]
                pycolmap.extract_features(
                    str(self.database), str(self.folder), files, pycolmap.CameraMode.SINGLE, self._reader(), options, pycolmap.Device.cpu
                )
        with closing(pycolmap.Database.open(str(self.database))) as base:
            for lens in self.lenses:
                camera = base.read_camera(_image(base, lens.names[0]).camera_id)
                if lens.focal is not None:
                    camera.params = [lens.focal, *list(camera.params)[1:]]
                    camera.has_prior_focal_length = True
                    base.update_camera(camera)
        marker.write_text("fine" if self.upsampled else "coarse")

    def _clear(self) -> None:
        for old in self.work.glob("*"):
            shutil.rmtree(old) if old.is_dir() else old.unlink()

    def choose_pairs(self, kind: str) -> list[pairing.Pair]:
        """Pairs of photos (indices into `names`) to match."""
        count = len(self.names)
        if kind == "exhaustive":
            return pairing.exhaustive(count)
        with self._timed("pairs", count):
            few = []
            with closing(pycolmap.Database.open(str(self.database))) as base:
                for name in self.names:
                    image = _image(base, name)
                    points = np.asarray(base.read_keypoints(image.image_id))
                    words = np.asarray(base.read_descriptors(image.image_id).data)
                    # Keypoints are x, y and the affine shape a11 a12 a21 a22, whose determinant is the scale squared.
                    scale = points[:, 2] * points[:, 5] - points[:, 3] * points[:, 4] if points.shape[1] >= 6 else points[:, 2]
                    few.append(pairing.strongest(words, np.abs(scale), RANKING_FEATURES))
            if kind == "ranked":
                scores = pairing.preemptive_scores(few, lambda done, total: self.tick("pairs", done, total))
                return pairing.best_pairs(scores, pairing.PARTNERS, pairing.NEIGHBOURS)
            scores = pairing.vlad_scores(few, self.seed)
            if kind == "vocabulary":
                return pairing.best_pairs(scores, 2 * pairing.PARTNERS, pairing.NEIGHBOURS)
            loops = pairing.best_pairs(scores, 4, 0)
            return sorted({*pairing.sequential(count), *loops})

    def match(self, pairs: Sequence[pairing.Pair]) -> None:
        """Match and verify pairs; those already in the database are not matched again."""
        names = self.names
        listing = self.work / "pairs.txt"
        listing.write_text("".join(f"{names[i]}.png {names[j]}.png\n" for i, j in pairs))
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = self.threads
        options.use_gpu = False
        geometry = pycolmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = self.seed
        chosen = pycolmap.ImportedPairingOptions()
        chosen.match_list_path = str(listing)
        chosen.block_size = BLOCK
        with self._timed("matching", len(pairs)):
            pycolmap.match_image_pairs(str(self.database), options, chosen, geometry, pycolmap.Device.cpu)

    def _mapper(self, weak: bool) -> Any:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = self.threads
        options.random_seed = self.seed
        options.mapper.random_seed = self.seed
        options.triangulation.random_seed = self.seed
        options.min_model_size = 3
        options.max_num_models = 10
        # Adjusting all cameras at every 10 % of growth is three quarters of COLMAP's time and gains nothing measurable here.
        options.ba_global_frames_ratio = 1.3
        options.ba_global_points_ratio = 1.3
        options.ba_global_max_refinements = 2
        options.mapper.ba_global_ignore_redundant_points3D = True
        if weak:
            options.mapper.abs_pose_min_num_inliers = WEAK_INLIERS
            options.mapper.abs_pose_min_inlier_ratio = WEAK_SHARE
        return options

    def _incremental(self, weak: bool, start: Any | None) -> Any | None:
        out = self.work / ("weak" if weak else "strict")
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        seeded = self.work / "start"
        shutil.rmtree(seeded, ignore_errors=True)
        if start is not None:
            seeded.mkdir()
            start.write(str(seeded))
        total = len(self.names)
        count = start.num_reg_images() if start is not None else 2
        lock = threading.Lock()

        def registered() -> None:
            nonlocal count
            with lock:
                count = min(count + 1, total)
                self.tick("mapping", count, total)

        with self._timed("mapping", total):
            models = pycolmap.incremental_mapping(
                str(self.database),
                str(self.folder),
                str(out),
                self._mapper(weak),
                input_path=str(seeded) if start is not None else "",
                next_image_callback=registered,
            )
        return largest(list(models.values()))

    def _global(self) -> Any | None:
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = self.threads
        options.random_seed = self.seed
        out = self.work / "global"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        with self._timed("mapping", len(self.names)):
            pycolmap.calibrate_view_graph(str(self.database))
            models = pycolmap.global_mapping(str(self.database), str(self.folder), str(out), options)
        return largest(list(models.values()))

    def missing(self, model: Any | None) -> list[int]:
        """Indices of photos that a model does not place."""
        there = registered_names(model)
        return [i for i, name in enumerate(self.names) if name not in there]

    def solve(self, kind: str, mapper: str) -> Any | None:
        """The largest reconstruction found, or None. In "auto" a poor one is tried again with the finest octave of features."""
        model = self._solve(kind, mapper)
        if self.fine == "auto" and not self.upsampled and len(self.missing(model)) > POOR * len(self.names):
            self._clear()
            self.fine = True
            model = largest([m for m in (model, self._solve(kind, mapper)) if m is not None])
        return model

    def _solve(self, kind: str, mapper: str) -> Any | None:
        self.features()
        marker = self.work / "matches.done"
        if not marker.exists():
            self.match(self.choose_pairs(kind))
            marker.touch()
        model = self._global() if mapper == "global" else self._incremental(False, None)
        lost = self.missing(model)
        if lost and mapper != "global":
            if kind != "exhaustive" and len(lost) <= max(10, len(self.names) // 4):
                everyone = range(len(self.names))
                self.match(sorted({(min(i, j), max(i, j)) for i in lost for j in everyone if i != j}))
            model = largest([m for m in (model, self._incremental(True, model)) if m is not None])
            if len(self.missing(model)) > 0.2 * len(self.names):  # a poor core: begin anew, weakly from the start
                model = largest([m for m in (model, self._incremental(True, None)) if m is not None])
        return model


def _image(base: Any, name: str) -> Any:
    """The database's entry of a photo; KeyError when its features could not be found."""
    image = base.read_image_with_name(f"{name}.png")
    if image is None:
        raise KeyError(f"COLMAP took no features from photo {name}")
    return image


def registered_names(model: Any | None) -> set[str]:
    """Names of the photos a reconstruction places."""
    if model is None:
        return set()
    return {image.name.rsplit(".", 1)[0] for image in model.images.values() if image.has_pose}


def largest(models: Sequence[Any]) -> Any | None:
    """The reconstruction with most photos, then most points; None of none."""
    return max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
