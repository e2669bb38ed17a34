"""A check of photos before anything is baked: small photos through ingestion and structure from motion, and what the result means.

Everything is measured as the stages measure it, on photos of at most CHECK_SIZE pixels, so that the check takes a small part of the
bake. It cannot see what only stereo and the material fit find out: gloss, missing texture on parts of the object, transparency.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from gsbake.capture.ingest import IngestOptions, ingest
from gsbake.capture.photos.quality import find_blurred
from gsbake.capture.poses.normalisation import nearest_point_to_axes
from gsbake.capture.sfm.solve import PoseSolver
from gsbake.config.schema import Ingest, Poses
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.monitor import SILENT, Monitor
from gsbake.text import shortlist

Level = Literal["problem", "advice", "good"]

#: Longer side of the photos that are checked, and features per photo.
CHECK_SIZE, CHECK_FEATURES = 800, 2048
#: Photos below which something is usually missing, and below which the shape is a guess.
ENOUGH_PHOTOS, FEW_PHOTOS = 30, 12
#: Stops between the brightest and the darkest photo (5 % and 95 % quantile) that show an automatic exposure.
EXPOSURE_RANGE = 0.7
#: Share of clipped pixels of the median photo, and its mean in log2 of linear luminance below which it is too dark.
CLIPPED_SHARE, DARK_STOPS = 0.03, -6.0
#: Value from which an 8-bit channel counts as clipped.
_CLIPPED = 254
#: Share of registered photos below which the poses will probably fail, and below which some are lost.
FAILED_SHARE, LOST_SHARE = 0.6, 0.95
#: Degrees around the object without a photo, and of elevation between the lowest and the highest photos (10 % and 90 % quantile).
SECTOR, HEIGHTS = 50.0, 15.0
#: Share of the photo that the median mask covers at least.
SMALL_SHARE = 0.04


@dataclass(frozen=True)
class Finding:
    """One result: its `level`, what it is `about`, the `text`, and what to `do` (empty where nothing)."""

    level: Level
    about: str
    text: str
    do: str = ""


def check_photos(
    photos: Path, work: Path, *, masks: Path | None = None, poses: Path | None = None, threads: int = 2, monitor: Monitor = SILENT
) -> tuple[list[Finding], dict[str, Any]]:
    """Check the photos of a folder or video, with their `masks` and known `poses`; the findings, worst first, and the figures behind them.

    Working files are written into the empty folder `work`. Raises BadInputError as `ingest` does.
    """
    (work / "ingest").mkdir()
    (work / "poses").mkdir()
    options = IngestOptions(Ingest(max_size=CHECK_SIZE), originals=False)
    ingest(photos, work / "ingest", options, masks=masks, poses=poses, threads=threads, monitor=monitor)
    listing = json.loads((work / "ingest/photos.json").read_text(encoding="utf-8"))
    entries: list[dict[str, Any]] = listing["photos"]
    clipped = [_clipped_share(work / "ingest", entry) for entry in entries]
    findings = [*_files(listing), *_pictures(entries), *_light(entries, clipped), *_masks(work / "ingest", entries)]
    found, figures = _cameras(work, entries, threads, monitor)
    figures["photos"] = _by_photo(listing, clipped, figures.get("not_registered"))
    order = ("problem", "advice", "good")
    return sorted([*findings, *found], key=lambda finding: order.index(finding.level)), figures


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _files(listing: dict[str, Any]) -> list[Finding]:
    """How many photos there are, and which were left out."""
    count, skipped = len(listing["photos"]), listing.get("skipped", [])
    findings = []
    if skipped:
        names = shortlist([f"{s['source']}: {s['why']}" for s in skipped])
        text = f"{_count(len(skipped), 'file')} cannot be used ({names})"
        findings.append(Finding("advice", "files", text, "Export them again, or leave them out."))
    more = "Take 40 to 80, all around and from two or three heights."
    if count < FEW_PHOTOS:
        findings.append(Finding("problem", "number of photos", f"{count} photos leave much of the shape to guess", more))
    elif count < ENOUGH_PHOTOS:
        findings.append(Finding("advice", "number of photos", f"{count} photos are few", more))
    else:
        findings.append(Finding("good", "number of photos", f"{count} photos"))
    return findings


def _pictures(entries: Sequence[dict[str, Any]]) -> list[Finding]:
    """Blurred and repeated photos."""
    findings = []
    blurred = [entries[i]["source"] for i in find_blurred([e["blur"] for e in entries])]
    if blurred:
        text = f"{_count(len(blurred), 'photo')} much more blurred than the rest: {shortlist(blurred)}"
        findings.append(Finding("advice", "sharpness", text, "Remove them if their neighbours remain, else take them again."))
    else:
        findings.append(Finding("good", "sharpness", "no photo is much more blurred than the rest"))
    repeated = [e["source"] for e in entries if e["duplicate_of"]]
    if repeated:
        text = f"{_count(len(repeated), 'photo')} with the same picture as another: {shortlist(repeated)}"
        findings.append(Finding("advice", "repeated photos", text, "They cost time and add nothing."))
    return findings


def _by_photo(listing: dict[str, Any], clipped: Sequence[float], missing: Sequence[str] | None) -> list[dict[str, Any]]:
    """What was found of each photo, and why the skipped ones are; `missing` names those without a camera, None where none were solved."""
    entries: list[dict[str, Any]] = listing["photos"]
    blurred = set(find_blurred([entry["blur"] for entry in entries]))
    found: list[dict[str, Any]] = [
        {
            "source": entry["source"], "blur": entry["blur"], "blurred": index in blurred, "exposure": entry["exposure"],
            "clipped": share, "duplicate_of": entry["duplicate_of"],
            "registered": None if missing is None else entry["name"] not in missing,
        }
        for index, (entry, share) in enumerate(zip(entries, clipped, strict=True))
    ]  # fmt: skip
    return found + [{"source": skipped["source"], "skipped": skipped["why"]} for skipped in listing["skipped"]]


def _light(entries: Sequence[dict[str, Any]], clipped_shares: Sequence[float]) -> list[Finding]:
    """Exposure of the photos: its range, clipped and dark ones."""
    stops = np.array([e["exposure"] for e in entries])
    spread = float(np.quantile(stops, 0.95) - np.quantile(stops, 0.05))
    findings = []
    if spread > EXPOSURE_RANGE:
        text = f"the brightest and the darkest photos differ by {spread:.1f} stops"
        do = "Set exposure and white balance by hand, or lock them; lamps and windows must not change."
        findings.append(Finding("advice", "exposure", text, do))
    else:
        findings.append(Finding("good", "exposure", f"photos agree to {spread:.1f} stops"))
    clipped = float(np.median(clipped_shares))
    if clipped > CLIPPED_SHARE:
        text = f"{100 * clipped:.0f} % of the object's pixels are clipped"
        findings.append(Finding("advice", "highlights", text, "Expose for the brightest part; what is clipped has no colour."))
    if float(np.median(stops)) < DARK_STOPS:
        text = f"the photos are dark (2^{np.median(stops):.1f} of white)"
        findings.append(Finding("advice", "brightness", text, "Use more light or a longer exposure on a tripod."))
    return findings


def _clipped_share(folder: Path, entry: dict[str, Any]) -> float:
    """Share of pixels, inside the mask or its guess, of which a channel is clipped."""
    image: Any = cv2.imread(str(folder / entry["file"]), cv2.IMREAD_COLOR)
    clipped = (image >= _CLIPPED).any(2)
    inside = _object(folder, entry, clipped.shape)
    return float(clipped[inside].mean() if inside is not None and inside.any() else clipped.mean())


def _object(folder: Path, entry: dict[str, Any], shape: tuple[int, ...]) -> Any:
    """The mask of a photo or its guess (h, w) at `shape`; None where there is neither."""
    file = entry["mask"] or entry.get("guess")
    if not file:
        return None
    mask: Any = cv2.imread(str(folder / file), cv2.IMREAD_GRAYSCALE)
    return cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_AREA) > 127


def _masks(folder: Path, entries: Sequence[dict[str, Any]]) -> list[Finding]:
    """Where masks come from, and how much of the photos the object fills."""
    given, guessed = sum(bool(e["mask"]) for e in entries), sum(not e["mask"] and bool(e.get("guess")) for e in entries)
    findings = []
    if given + guessed < len(entries):
        text = f"{len(entries) - given - guessed} of {len(entries)} photos have no mask"
        findings.append(Finding("advice", "masks", text, "Give masks, or install the mask network (`gsbake doctor` says how)."))
    else:
        guesses = f", {guessed} of them guessed; look at the report's doubtful ones" if guessed else ""
        findings.append(Finding("good", "masks", f"every photo has a mask{guesses}"))
    shares = [float(o.mean()) for e in entries if (o := _object(folder, e, (e["height"], e["width"]))) is not None]
    if shares and float(np.median(shares)) < SMALL_SHARE:
        text = f"the object fills {100 * np.median(shares):.1f} % of the photos"
        findings.append(Finding("advice", "size in the photo", text, "Go nearer or use a longer lens; only its pixels become texture."))
    return findings


def _cameras(work: Path, entries: list[dict[str, Any]], threads: int, monitor: Monitor) -> tuple[list[Finding], dict[str, Any]]:
    """Whether the photos can be registered, and from where they look."""
    settings = Poses(max_size=CHECK_SIZE, max_features=CHECK_FEATURES, min_registered=0)
    solver = PoseSolver(work / "ingest", entries, work / "poses", settings, 0, threads, monitor)
    given = (work / "ingest/poses/cameras.json").exists()
    try:
        solved = solver.triangulate() if given else solver.solve()
    except BadInputError as error:
        return [Finding("problem", "cameras", str(error).rstrip("."), "See `How to photograph` in the documentation.")], {}
    findings = []
    missing, total = list(solved.figures.get("not_registered", [])), len(entries)
    share = 1 - len(missing) / total
    if given:
        findings.append(Finding("good", "cameras", f"{len(solved.cameras)} of {total} photos have a given pose"))
    elif share < LOST_SHARE:
        text = f"only {total - len(missing)} of {total} small photos could be registered (not {shortlist(missing)})"
        do = "Photos overlap by two thirds; add some between these and their neighbours. A bake at full size may still register them."
        findings.append(Finding("problem" if share < FAILED_SHARE else "advice", "cameras", text, do))
    else:
        error_px = solved.figures["reprojection_px"]
        text = f"{total - len(missing)} of {total} photos registered, reprojection error {error_px:.2f} px"
        findings.append(Finding("good", "cameras", text))
    if solved.figures.get("masked_features") or solved.figures.get("moving_features"):
        where = "inside its masks" if solved.figures["masked_features"] else "on what moves"
        text = f"the object moves against its surroundings; features {where} place the cameras"
        findings.append(Finding("good", "background", text))
    if share >= FAILED_SHARE:  # a few cameras say nothing about the others
        findings += coverage(solved.cameras)
    return findings, {key: value for key, value in solved.figures.items() if key != "seconds"}


def coverage(cameras: Sequence[Camera]) -> list[Finding]:
    """Sides and heights from which no photo looks; the world is Z-up."""
    centre = nearest_point_to_axes(cameras)
    towards = np.stack([camera.centre - centre for camera in cameras])
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    elevation = np.degrees(np.arcsin(np.clip(towards[:, 2], -1, 1)))
    around = [i for i in range(len(cameras)) if elevation[i] < 75]  # those from above look from every side
    findings = []
    if len(around) >= 2:
        azimuth = np.degrees(np.arctan2(towards[around, 1], towards[around, 0]))
        order = np.argsort(azimuth, kind="stable")
        gaps = np.diff(np.append(azimuth[order], azimuth[order[0]] + 360))
        widest = int(gaps.argmax())
        before, after = (cameras[around[int(order[(widest + k) % len(order)])]].name for k in (0, 1))
        if gaps[widest] > SECTOR:
            text = f"no photo was taken from a sector of {gaps[widest]:.0f}°, between {before} and {after}"
            findings.append(Finding("advice", "sides", text, "Take photos there, every 10 to 15°, or that side is a guess."))
        else:
            findings.append(Finding("good", "sides", f"photos look from all sides, at most {gaps[widest]:.0f}° apart"))
    low, high = np.quantile(elevation, 0.1), np.quantile(elevation, 0.9)
    if high - low < HEIGHTS:
        text = f"all photos look from one height ({math.floor(low)}° to {math.ceil(high)}° above the horizontal)"
        findings.append(Finding("advice", "heights", text, "Add a round from above, and one from lower down."))
    else:
        findings.append(Finding("good", "heights", f"photos look from {math.floor(low)}° to {math.ceil(high)}° above the horizontal"))
    return findings
