"""Estimates of a stage's time and memory from the photos and the settings, corrected by earlier runs.

The formulas give the order of magnitude: seconds on two cores and resident megabytes, fitted to `gsbake run` with the profiles preview and
relight on two captures of 40 and 48 small photos. What earlier runs in the same folder took corrects them: the median ratio of
measured and estimated seconds, and the largest ratio of memory, per stage; runs with the same settings count alone where there are any.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from gsbake.pipeline.store import Store
from gsbake.timing.photos import PhotoSet, photos_of_run
from gsbake.timing.usual_parts import usual_parts

#: Exponent of the speed-up by threads: 2 threads are 1.74 times as fast as 1.
_THREAD_EXPONENT = 0.8
#: Threads on which the formulas were fitted.
_FITTED_THREADS = 2
#: Room above the largest memory that was measured, and above that of a formula.
_MEMORY_MARGIN, _MEMORY_MARGIN_OF_FORMULA = 1.2, 1.5


@dataclass(frozen=True)
class Estimate:
    """Expected seconds, and megabytes of memory to reserve.

    `measured` is the number of earlier runs behind the correction, `same` whether they had the same settings; `parts` are the shares of the
    stage's parts in its seconds, in running order.
    """

    seconds: float
    memory_mb: int
    measured: int = 0
    parts: Mapping[str, float] = field(default_factory=dict)
    same: bool = False


def formula(stage: str, photos: PhotoSet, settings: Mapping[str, Any]) -> tuple[float, float]:
    """Seconds on two cores and megabytes of a stage, from the photos and {"section.key": value}; 10 s and 500 MB for an unknown stage."""

    def value(name: str, default: float) -> float:
        found = settings.get(name, default)
        return float(found) if isinstance(found, int | float) else default

    def megapixels(name: str, default: float) -> float:
        """Size of a photo whose longer side is limited by a setting; photos are taken as 4 : 3."""
        return min(photos.megapixels, 0.75e-6 * value(name, default) ** 2)

    count, texels = photos.count, 1e-6 * value("bake.size", 1024) ** 2
    step = 0.012 + 0.15 * megapixels("train.max_size", 512)
    matched = count * max(megapixels("stereo.max_size", 800), value("stereo.min_scale", 0.3) ** 2 * photos.megapixels)
    fit = settings.get("bake.materials") == "fit"
    # A base colour of automatic size has about as many texels as a photo has pixels; it is projected in bands.
    fine = min(photos.megapixels, 17.0) if settings.get("bake.size") == "auto" and photos.megapixels > 2.5 else 0.0
    match stage:
        case "ingest":
            return 0.5 + 0.12 * count * photos.megapixels, 130 + 40 * photos.megapixels
        case "poses":
            return 2 + 0.05 * count + 0.002 * count**2, 300 + 60 * megapixels("poses.max_size", 1600)
        case "stereo":
            return (1.0, 300.0) if settings.get("stereo.enabled") == "never" else (1 + 3 * matched, 350 + 50 * matched)
        case "train":
            return 3 + step * value("train.iterations", 3000), 500 + 0.004 * value("surfels.max_count", 60_000)
        case "refine":
            return 3 + step * value("refine.iterations", 300), 450 + 0.004 * value("surfels.max_count", 60_000)
        case "mesh":
            return 2 + 0.08 * value("mesh.max_resolution", 384), 450 + 0.8 * value("mesh.max_resolution", 384)
        case "bake":
            return (
                6 + (110 if fit else 8) * texels + 0.2 * count * fine,
                max(700 + (1100 if fit else 320) * texels, 500 + 60 * photos.megapixels + 60 * fine),
            )
        case "export":
            return 2 + 4 * texels + 1.2 * fine, 300 + 270 * texels + 60 * fine
        case "report":
            return 7.0, 830.0
    return 10.0, 500.0


@dataclass(frozen=True)
class Measured:
    """An earlier run of a stage: its settings, the ratios of measured and estimated seconds and memory, and the share of each part."""

    settings: Mapping[str, Any]
    seconds: float
    memory: float
    parts: Mapping[str, float]


@dataclass
class History:
    """Earlier runs by stage, newest first where they were read so."""

    runs: dict[str, list[Measured]] = field(default_factory=dict)

    @staticmethod
    def of_runs(outs: Iterable[Path], stages: Iterable[str]) -> History:
        """The history of the output folders `outs`; folders without a finished ingest, or that cannot be read, are left out."""
        history, names = History(), list(stages)
        for out in outs:
            with suppress(OSError):
                photos = photos_of_run(out)
                if photos is not None:
                    for stage in names:
                        for _, manifest in Store(out).manifests(stage):
                            history.add(stage, photos, manifest)
        return history

    def add(self, stage: str, photos: PhotoSet, manifest: Mapping[str, Any]) -> None:
        """Add one manifest. A resumed stage is left out: its time is that of the rest only."""
        settings, seconds, peak = manifest.get("settings", {}), manifest.get("seconds"), manifest.get("peak_bytes")
        threads, parts = manifest.get("threads"), manifest.get("parts") or {}
        if manifest.get("resumed") or not isinstance(seconds, int | float) or not isinstance(peak, int) or not isinstance(threads, int):
            return
        expected, memory = formula(stage, photos, settings)
        alone = seconds / at_threads(1.0, max(threads, 1))
        shares = {name: part / seconds for name, part in parts.items()} if seconds > 0 else {}
        self.runs.setdefault(stage, []).append(Measured(settings, alone / expected, peak / 1e6 / memory, shares))

    def estimate(self, stage: str, photos: PhotoSet, settings: Mapping[str, Any], threads: int) -> Estimate:
        """The estimate of a stage with the values of its `settings` (those it declares), on `threads` threads.

        Shares of parts are those of a run with the same settings, else those of `usual_parts`: other settings have other parts.
        """
        seconds, memory = formula(stage, photos, settings)
        known = self.runs.get(stage, [])
        same = [run for run in known if run.settings == settings]
        parts = same[0].parts if same else usual_parts(stage, settings)
        known = same or known
        if not known:
            return Estimate(at_threads(seconds, threads), math.ceil(memory * _MEMORY_MARGIN_OF_FORMULA), parts=parts)
        speed, room = median(run.seconds for run in known), max(run.memory for run in known)
        return Estimate(at_threads(seconds * speed, threads), math.ceil(memory * room * _MEMORY_MARGIN), len(known), parts, bool(same))


def at_threads(seconds: float, threads: int) -> float:
    """Time on `threads` threads of what takes `seconds` on those of the formulas."""
    return seconds * float((_FITTED_THREADS / threads) ** _THREAD_EXPONENT)
