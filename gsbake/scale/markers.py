"""Printed square markers of a known size: ArUco and AprilTag, alone or on a ChArUco board (Garrido-Jurado et al., *Automatic generation and
detection of highly reliable fiducial markers under occlusion*, Pattern Recognition 2014; Olson, *AprilTag*, ICRA 2011; OpenCV's detector).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera
from gsbake.imaging.srgb import decode
from gsbake.scale.triangulation import Ray, camera_rays, triangulate_together

#: OpenCV's dictionaries by name; each holds the smaller ones of its kind.
DICTIONARIES = {
    "aruco-4x4": cv2.aruco.DICT_4X4_1000,
    "aruco-5x5": cv2.aruco.DICT_5X5_1000,
    "aruco-6x6": cv2.aruco.DICT_6X6_1000,
    "aruco-7x7": cv2.aruco.DICT_7X7_1000,
    "aruco-original": cv2.aruco.DICT_ARUCO_ORIGINAL,
    "apriltag-16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "apriltag-25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag-36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
#: Photos among which the dictionary is looked for.
SAMPLE = 12
#: Photos that must show a marker, and its largest residual in pixels: patterns that are no marker, or move, are not consistent.
MIN_PHOTOS, MAX_RESIDUAL = 3, 2.0
#: Share of a photo's pixels that are darker than its white, and the least white, in linear light.
WHITE_QUANTILE, MIN_WHITE = 0.999, 1e-3
#: Standard deviation of a detected corner in pixels.
CORNER_NOISE = 0.3


@dataclass(frozen=True)
class Marker:
    """A marker: `number` in its dictionary, its four `corners` (4, 3), the lengths of its `sides` (4,), and the `photos` that show it."""

    number: int
    corners: Array
    sides: Array
    photos: int


def find_markers(cameras: Sequence[Camera], folder: Path, dictionary: str = "auto") -> tuple[str, list[Marker]]:
    """The markers of the photos `folder/<name>.png` in the frame of `cameras`, and their dictionary ("" where there is none).

    With "auto" it is the dictionary of which most markers are seen in a sample of the photos. The corners of a marker are triangulated from
    all photos that agree; markers that fewer than MIN_PHOTOS show, and numbers that a photo shows twice, are left out.
    """
    if dictionary == "auto":
        dictionary = _most_seen(cameras[:: max(1, len(cameras) // SAMPLE)], folder)
    if not dictionary:
        return "", []
    seen: dict[int, list[list[Ray]]] = defaultdict(list)
    for camera in cameras:
        for number, corners in _detect(_read(folder / f"{camera.name}.png"), dictionary).items():
            seen[number].append(camera_rays(camera, corners))
    markers = [_marker(number, views) for number, views in sorted(seen.items())]
    return dictionary, [marker for marker in markers if marker is not None]


def _most_seen(cameras: Iterable[Camera], folder: Path) -> str:
    """The dictionary whose markers several photos show most often; "" when there is none."""
    counts = {name: Counter[int]() for name in DICTIONARIES}
    for camera in cameras:
        image = _read(folder / f"{camera.name}.png")
        for name, count in counts.items():
            count.update(_detect(image, name).keys())
    # A pattern that only looks like a marker of a small dictionary is seldom read twice as the same one.
    repeated = {name: sum(n for n in count.values() if n > 1) for name, count in counts.items()}
    best = max(repeated, key=lambda name: repeated[name])
    return best if repeated[best] else ""


def _detect(image: NDArray[np.uint8], dictionary: str) -> dict[int, Array]:
    """Corners (4, 2) in pixels of each marker number that a photo, read by `_read`, shows once."""
    settings = cv2.aruco.DetectorParameters()
    # The others make markers too small: by .2 to 1.2 % (corners) and .7 to 2.8 % (contours) for edges of 160 to 40 pixels.
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]), settings)
    corners, numbers, _ = detector.detectMarkers(image)
    if numbers is None:
        return {}
    flat = numbers.ravel().astype(int).tolist()
    # AprilTag's refinement counts from the photo's corner, as gsbake does, unlike the rest of OpenCV.
    return {n: np.asarray(c, np.float64).reshape(4, 2) for n, c in zip(flat, corners, strict=True) if flat.count(n) == 1}


def _read(path: Path) -> NDArray[np.uint8]:
    """The sRGB photo in linear light (h, w), its brightest pixels white.

    A pixel half covered by white paper is half as bright, but nearer to white in sRGB, where black markers look smaller (by half a percent
    at edges of 70 pixels).
    """
    photo: Any = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if photo is None:
        raise FileNotFoundError(path)
    light = decode(np.linspace(0, 1, 256, dtype=np.float32))
    white = max(float(light[int(np.quantile(photo, WHITE_QUANTILE))]), MIN_WHITE)
    levels = np.clip(255 * light / white, 0, 255).round().astype(np.uint8)
    return np.asarray(levels[photo])


def _marker(number: int, views: list[list[Ray]]) -> Marker | None:
    """The marker that all `views` but outliers agree on; None where there is none."""
    found = triangulate_together(views, CORNER_NOISE, MAX_RESIDUAL, MIN_PHOTOS)
    if found is None:
        return None
    corners, photos = found
    return Marker(number, corners, np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1), photos)
