"""SIFT features of photos (Lowe, *Distinctive image features from scale-invariant keypoints*, IJCV 2004), detected by COLMAP or taken from
the cache, in a COLMAP database."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.colmap import pycolmap
from gsbake.capture.sfm.feature_cache import Descriptors, FeatureCache, Keypoints, photo_key

#: Median features per photo from which the finest octave is skipped.
ENOUGH_FEATURES = 1500


@dataclass
class FeatureOptions:
    """Settings of feature detection: features per photo, SIFT's peak threshold, longer side in pixels, and whether the finest octave
    (photos enlarged twice) is used: True, False or "auto"."""

    max_features: int
    peak_threshold: float
    max_size: int
    fine: bool | str


@dataclass
class FeatureDetection:
    """Detects features in photos `folder/<name>.png` under masks `mask_folder/<name>.png.png`; `cache` keeps them beyond the run.

    `upsampled` tells whether features include the finest octave, `detected` the photos whose features were computed.
    """

    folder: Path
    mask_folder: Path | None
    options: FeatureOptions
    threads: int
    cache: FeatureCache
    upsampled: bool = False
    detected: set[str] = field(default_factory=set)
    _known_keys: dict[bool, dict[str, str]] = field(default_factory=dict)

    def _extraction(self) -> Any:
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = self.threads
        options.use_gpu = False
        options.max_image_size = self.options.max_size
        options.sift.max_num_features = self.options.max_features
        options.sift.peak_threshold = self.options.peak_threshold
        options.sift.first_octave = -1 if self.upsampled else 0
        return options

    def choose_octave(self, probe: Path, names: Sequence[str]) -> None:
        """Decide whether features include the finest octave; with "auto" by those of three of the photos, in a database at `probe`."""
        self.upsampled = self._needs_fine(probe, names) if self.options.fine == "auto" else bool(self.options.fine)

    def _needs_fine(self, probe: Path, names: Sequence[str]) -> bool:
        sample = [names[i] for i in sorted({0, len(names) // 2, len(names) - 1})]
        self.upsampled = False
        pycolmap.Database.open(str(probe)).close()
        self.detect(probe, sample, pycolmap.CameraMode.PER_IMAGE)
        with closing(pycolmap.Database.open(str(probe))) as base:
            counts = [base.num_keypoints_for_image(image.image_id) for image in base.read_all_images()]
        return not counts or float(np.median(counts)) < min(ENOUGH_FEATURES, 0.5 * self.options.max_features)

    def keys(self, names: Sequence[str]) -> dict[str, str]:
        """Keys of the features of photos by their names; each photo is read once."""
        o = self.options
        detection = {
            "pycolmap": pycolmap.__version__, "size": o.max_size, "count": o.max_features, "peak": o.peak_threshold, "fine": self.upsampled,
        }  # fmt: skip
        known = self._known_keys.setdefault(self.upsampled, {})
        for name in (name for name in names if name not in known):
            mask = None if self.mask_folder is None else self.mask_folder / f"{name}.png.png"
            known[name] = photo_key(self.folder / f"{name}.png", mask, detection)
        return {name: known[name] for name in names}

    def detect(self, database: Path, names: Sequence[str], mode: Any) -> None:
        """Write the features of photos, which share a lens, into a database: kept ones, and those of the other photos."""
        keys, files = self.keys(names), {name: f"{name}.png" for name in names}
        # Photos get their identifiers in this order; extraction would number them as its threads finish, and everything after it depends
        # on the numbers.
        pycolmap.import_images(str(database), str(self.folder), mode, list(files.values()), self._reader())
        with closing(pycolmap.Database.open(str(database))) as base:
            absent = [name for name in names if not self._write_features(base, name, self.cache.features(keys[name]))]
        if not absent:
            return
        self.detected.update(absent)
        pycolmap.extract_features(
            str(database), str(self.folder), [files[name] for name in absent], mode, self._reader(), self._extraction(), pycolmap.Device.cpu
        )
        with closing(pycolmap.Database.open(str(database))) as base:
            for name in absent:
                image = image_of(base, name).image_id
                self.cache.keep_features(keys[name], np.asarray(base.read_keypoints(image)), np.asarray(base.read_descriptors(image).data))

    @staticmethod
    def _write_features(base: Any, name: str, found: tuple[Keypoints, Descriptors] | None) -> bool:
        """Write kept features of a photo; returns whether there are any."""
        if found is None:
            return False
        image, (keypoints, descriptors) = image_of(base, name).image_id, found
        base.write_keypoints(image, keypoints)
        base.write_descriptors(image, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors))
        return True

    def _reader(self) -> Any:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        if self.mask_folder is not None:
            reader.mask_path = str(self.mask_folder)
        return reader


def image_of(base: Any, name: str) -> Any:
    """The database entry of a photo; raises KeyError when the photo has none."""
    image = base.read_image_with_name(f"{name}.png")
    if image is None:
        raise KeyError(f"the COLMAP database has no entry of photo {name}")
    return image
