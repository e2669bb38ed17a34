"""Structure from motion with COLMAP (Schönberger, Frahm, *Structure-from-Motion Revisited*, CVPR 2016) on one database.

Steps: SIFT features (`sfm.features`), pair selection, matching (`sfm.matching`), verification of matches by two-view geometry, mapping in
two passes. The first pass uses strict thresholds; photos that it does not register are matched with all others and registered to its model
under relaxed thresholds. Where photos are still missing, models that mapping left apart are merged (`sfm.merging`). Runs in the process of
`sfm.worker`. The same photos and seed give the same bytes with any number of threads.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.colmap import pycolmap, repeatable_mapping
from gsbake.capture.sfm import pairs as pairing
from gsbake.capture.sfm.feature_cache import FeatureCache
from gsbake.capture.sfm.features import FeatureDetection, FeatureOptions, image_of
from gsbake.capture.sfm.mapping_gain import FIRST_PHOTOS, MappingGain
from gsbake.capture.sfm.matching import Matches, match_pairs
from gsbake.capture.sfm.merging import merge_all, new_photos
from gsbake.capture.sfm.verification import verify

Tick = Callable[[str, int, int], None]

#: Relaxed thresholds of the second pass: inliers, and their ratio, that register a photo (COLMAP's defaults: 30 and 0.25).
RELAXED_MIN_INLIERS, RELAXED_MIN_INLIER_RATIO = 15, 0.15
#: Largest features per photo in the ranking of pairs.
RANKING_FEATURES = 256
#: Share of unregistered photos above which the finest octave of features is added.
MAX_UNREGISTERED_SHARE = 0.05
#: Pixels by which the features of a match must differ in photos of a camera that stood.
MIN_MOTION = 1.5
#: Photos whose descriptors are kept in memory while pairs are matched, about 1 MB each.
CACHED_PHOTOS = 128


@dataclass(frozen=True)
class Lens:
    """Photos that share intrinsics: their names, their size in pixels, and an initial focal length in pixels where EXIF has one."""

    names: tuple[str, ...]
    width: int
    height: int
    focal: float | None = None


@dataclass
class SfmPipeline:
    """One SfM run: photos `folder/<name>.png`, masks `mask_folder/<name>.png.png`, database and models in `work`.

    `cache` keeps features and matches beyond the run. `one_camera` are pairs of photos of a camera that stood while the object turned: what
    stands in them is not the object. `seconds` holds the time of each part, `matched` and `verified` the number of pairs whose matches and
    geometry were computed, `steps` what was tried in turn and how many photos the best model had after it.
    """

    folder: Path
    work: Path
    lenses: Sequence[Lens]
    mask_folder: Path | None
    options: FeatureOptions
    threads: int
    seed: int
    tick: Tick
    cache: FeatureCache = field(default_factory=lambda: FeatureCache(None))
    one_camera: Set[frozenset[str]] = frozenset()
    seconds: dict[str, float] = field(default_factory=dict)
    matched: int = 0
    verified: int = 0
    steps: list[tuple[str, int]] = field(default_factory=list)
    detection: FeatureDetection = field(init=False)
    _models: list[Any] = field(default_factory=list)  # all that incremental mapping found

    def __post_init__(self) -> None:
        self.detection = FeatureDetection(self.folder, self.mask_folder, self.options, self.threads, self.cache)

    @property
    def database(self) -> Path:
        """Path of the COLMAP database."""
        return self.work / "database.db"

    @property
    def names(self) -> list[str]:
        """Names of all photos, sorted."""
        return sorted(name for lens in self.lenses for name in lens.names)

    @contextmanager
    def _timed(self, part: str, total: int) -> Iterator[None]:
        """Report the start of a part and time it."""
        start = time.perf_counter()
        self.tick(part, 0, total)
        try:
            yield
        finally:
            self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start

    def features(self) -> None:
        """Detect SIFT features in all photos and store them in the database, from which an interrupted run resumes.

        The finest octave costs five times as much as all others and holds most features but not the best ones; "auto" skips it where the
        others suffice.
        """
        marker = self.work / "features.done"
        if marker.exists():
            self.detection.upsampled = marker.read_text(encoding="utf-8") == "fine"
            return
        self._clear()
        with self._timed("features", len(self.names)):
            self.detection.choose_octave(self.work / "probe.db", self.names)
            pycolmap.Database.open(str(self.database)).close()
            for lens in self.lenses:
                self.detection.detect(self.database, lens.names, pycolmap.CameraMode.SINGLE)
        with closing(pycolmap.Database.open(str(self.database))) as base:
            for lens in self.lenses:
                camera = base.read_camera(image_of(base, lens.names[0]).camera_id)
                if lens.focal is not None:
                    camera.params = [lens.focal, *list(camera.params)[1:]]
                    camera.has_prior_focal_length = True
                    base.update_camera(camera)
        marker.write_bytes(b"fine" if self.detection.upsampled else b"coarse")

    def _clear(self) -> None:
        for path in self.work.glob("*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def choose_pairs(self, kind: str) -> list[pairing.Pair]:
        """Pairs of photos (indices into `names`) to match; `kind` as returned by `choose_matching`."""
        count = len(self.names)
        if kind == "exhaustive":
            return pairing.exhaustive(count)
        with self._timed("pairs", count):
            features = []
            with closing(pycolmap.Database.open(str(self.database))) as base:
                for name in self.names:
                    image = image_of(base, name)
                    points = np.asarray(base.read_keypoints(image.image_id))
                    descriptors = np.asarray(base.read_descriptors(image.image_id).data)
                    # Keypoints are x, y and the affine shape a11 a12 a21 a22, whose determinant is the scale squared.
                    scale = points[:, 2] * points[:, 5] - points[:, 3] * points[:, 4] if points.shape[1] >= 6 else points[:, 2]
                    features.append(pairing.largest_features(descriptors, np.abs(scale), RANKING_FEATURES))
            if kind == "ranked":
                scores = pairing.preemptive_scores(features, lambda done, total: self.tick("pairs", done, total))
                return pairing.best_pairs(scores, pairing.PARTNERS, pairing.NAME_NEIGHBOURS)
            scores = pairing.vlad_scores(features, self.seed)
            if kind == "vocabulary":
                return pairing.best_pairs(scores, 2 * pairing.PARTNERS, pairing.NAME_NEIGHBOURS)
            loops = pairing.best_pairs(scores, 4, 0)
            return sorted({*pairing.sequential(count), *loops})

    def match(self, pairs: Sequence[pairing.Pair]) -> None:
        """Match and verify the pairs that are not in the database yet."""
        names = self.names
        with self._timed("matching", len(pairs)), closing(pycolmap.Database.open(str(self.database))) as base:
            ids = {image.name.rsplit(".", 1)[0]: image.image_id for image in base.read_all_images()}
            key = {ids[name]: key for name, key in self.detection.keys(names).items()}
            numbered, missing = [(ids[names[i]], ids[names[j]]) for i, j in pairs], []
            standing = {pair for pair, (i, j) in zip(numbered, pairs, strict=True) if frozenset((names[i], names[j])) in self.one_camera}

            def moved(pair: pairing.Pair, matches: Matches) -> Matches:
                if pair not in standing:
                    return matches
                first, second = (np.asarray(base.read_keypoints(image))[:, :2] for image in pair)
                return matches[np.linalg.norm(first[matches[:, 0]] - second[matches[:, 1]], axis=1) >= MIN_MOTION]

            for pair in numbered:
                if base.exists_matches(*pair):
                    continue
                if (kept := self.cache.matches((key[pair[0]], key[pair[1]]))) is None:
                    missing.append(pair)
                else:
                    base.write_matches(*pair, moved(pair, kept))
            self.matched += len(missing)

            @lru_cache(maxsize=CACHED_PHOTOS)
            def descriptors(image: int) -> NDArray[np.uint8]:
                return np.asarray(base.read_descriptors(image).data)

            for done, (pair, matches) in enumerate(match_pairs(missing, descriptors, self.threads), len(pairs) - len(missing) + 1):
                base.write_matches(*pair, moved(pair, matches))
                self.cache.keep_matches((key[pair[0]], key[pair[1]]), matches)
                self.tick("matching", done, len(pairs))
        with self._timed("verification", 1):
            self.verified += verify(self.database, numbered, standing, key, self.cache, self.seed)

    def _mapper(self, relaxed: bool) -> Any:
        options = repeatable_mapping(self.seed)
        options.mapper.num_threads = 1
        options.mapper.random_seed = self.seed
        options.triangulation.random_seed = self.seed
        options.min_model_size = 3
        options.max_num_models = 10
        # COLMAP's default, global bundle adjustment at every 10 % of growth, is three quarters of its time without measurable gain.
        options.ba_global_frames_ratio = 1.3
        options.ba_global_points_ratio = 1.3
        options.ba_global_max_refinements = 2
        options.mapper.ba_global_ignore_redundant_points3D = True
        if relaxed:
            options.mapper.abs_pose_min_num_inliers = RELAXED_MIN_INLIERS
            options.mapper.abs_pose_min_inlier_ratio = RELAXED_MIN_INLIER_RATIO
        return options

    def _incremental(self, relaxed: bool, initial: Any | None) -> Any | None:
        """The largest model of incremental mapping, continued from the model `initial` if there is one."""
        out = self.work / ("relaxed" if relaxed else "strict")
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        initial_folder = self.work / "initial"
        shutil.rmtree(initial_folder, ignore_errors=True)
        if initial is not None:
            initial_folder.mkdir()
            initial.write(str(initial_folder))
        total = len(self.names)
        gain = MappingGain(total, initial.num_reg_images() if initial is not None else FIRST_PHOTOS)
        lock, end = threading.Lock(), pycolmap.CancellationToken()

        def begun() -> None:
            with lock:
                if gain.model_begins():
                    end.cancel()

        def registered() -> None:
            with lock:
                if gain.photo_registered():
                    end.cancel()
                self.tick("mapping", min(gain.registered, total), total)

        with self._timed("mapping", total):
            try:
                found = pycolmap.incremental_mapping(
                    str(self.database),
                    str(self.folder),
                    str(out),
                    self._mapper(relaxed),
                    input_path=str(initial_folder) if initial is not None else "",
                    initial_image_pair_callback=begun,
                    next_image_callback=registered,
                    cancellation_token=end,
                )
                models = list(found.values())
            except InterruptedError:  # by the token; the models are written, the present one too
                models = [pycolmap.Reconstruction(str(path)) for path in written_models(out)]
        self._models += models
        return largest(models)

    def _models_beside(self, model: Any | None) -> list[Any]:
        """Models with photos that `model`, one of the present features, does not register."""
        if not any(model is found for found in self._models):
            return []
        return [other for other in self._models if new_photos(model, other)]

    def _merged(self, model: Any, others: Sequence[Any]) -> Any:
        """`model` with all `others` that can be tied to it, and photos that then register to it."""
        with self._timed("mapping", len(self.names)):
            merged = merge_all(model, others, self.database, self.folder, self.work / "merged", self.seed)
        return merged if merged is model or not self.missing(merged) else self._incremental(True, merged)

    def _global(self) -> Any | None:
        """The largest model of global mapping."""
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = 1  # as in repeatable_mapping
        options.random_seed = self.seed
        out = self.work / "global"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        with self._timed("mapping", len(self.names)):
            pycolmap.calibrate_view_graph(str(self.database))
            models = pycolmap.global_mapping(str(self.database), str(self.folder), str(out), options)
        return largest(list(models.values()))

    def missing(self, model: Any | None) -> list[int]:
        """Indices of photos that a model does not register."""
        registered = registered_names(model)
        return [i for i, name in enumerate(self.names) if name not in registered]

    def solve(self, kind: str, mapper: str) -> Any | None:
        """The largest reconstruction found, or None. With fine "auto", a poor one is repeated with the finest octave of features.

        The `mapper` "trial" maps once, with weak thresholds.
        """
        model = self._solve(kind, mapper, None)
        poor = len(self.missing(model)) > MAX_UNREGISTERED_SHARE * len(self.names)
        if poor and mapper != "trial" and self.options.fine == "auto" and not self.detection.upsampled:
            self._clear()
            self.options.fine = True
            model = self._solve(kind, mapper, model)
        return model

    def _solve(self, kind: str, mapper: str, model: Any | None) -> Any | None:
        """The largest of `model` and those of all steps with the present features."""

        def tried(step: str, found: Any | None) -> Any | None:
            best = largest([m for m in (model, found) if m is not None])
            self.steps.append((f"{step}, finest octave of features" if self.detection.upsampled else step, len(registered_names(best))))
            return best

        self._models.clear()  # features of one kind have numbers of their own
        self.features()
        marker = self.work / "matches.done"
        if not marker.exists():
            self.match(self.choose_pairs(kind))
            marker.touch()
        if mapper == "global":
            return tried("global mapping", self._global())
        if mapper == "trial":
            return tried("weaker thresholds from the start", self._incremental(True, None))
        first = self._incremental(False, None)
        model = tried("strict thresholds", first)
        missing = self.missing(first)
        if missing:
            if kind != "exhaustive" and len(missing) <= max(10, len(self.names) // 4):
                count = len(self.names)
                self.match(sorted({(min(i, j), max(i, j)) for i in missing for j in range(count) if i != j}))
            model = tried("weaker thresholds", self._incremental(True, first))
            if len(self.missing(model)) > 0.2 * len(self.names):  # the strict model was poor
                model = tried("weaker thresholds from the start", self._incremental(True, None))
            if others := self._models_beside(model):
                model = tried("merging of models", self._merged(model, others))
        return model


def registered_names(model: Any | None) -> set[str]:
    """Names of the registered photos of a reconstruction."""
    if model is None:
        return set()
    return {image.name.rsplit(".", 1)[0] for image in model.images.values() if image.has_pose}


def written_models(folder: Path) -> list[Path]:
    """Folders of the models that mapping wrote into `folder`: its numbered ones, in order, or itself where mapping continued a model."""
    found = (path.parent for path in folder.rglob("images.bin"))
    return sorted(found, key=lambda path: (len(path.name), path.name))


def largest(models: Sequence[Any]) -> Any | None:
    """The reconstruction with most registered photos, then most points; None when there is none."""
    return max(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
