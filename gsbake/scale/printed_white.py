"""Places of known reflectance beside the object: the white cells of printed markers, and the grey patches of a colour card.

The card is one of 24 patches, whose last row is grey (McCamy, Marcus & Davidson, *A color-rendition chart*, Journal of Applied Photographic
Engineering 1976); OpenCV's `mcc` finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.config.white import PrintedWhite
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera
from gsbake.scale.markers import DICTIONARIES, MIN_PHOTOS, find_markers
from gsbake.scale.triangulation import Ray, camera_rays, triangulate_together

#: Reflectance of the brightest patches of the card's last row, by the maker's densities .05, .23, .44 and .70; darker ones show glare.
GREYS = (0.90, 0.591, 0.362, 0.198)
#: The card's patches, and the place of the first grey one.
PATCHES, FIRST_GREY = 24, 18
#: The detector places the patches to some pixels: noise, and the largest residual of a photo that counts.
CARD_NOISE, MAX_CARD_RESIDUAL = 2.0, 8.0


@dataclass(frozen=True)
class PrintedPatches:
    """Points (k, 3) of a plane with the `normal` (3,) towards the cameras, their `reflectance` (k,), the distance between neighbours, which
    tells how large they are, and what they are called."""

    name: str
    points: Array
    normal: Array
    reflectance: Array
    spacing: float


def find_printed(white: PrintedWhite, cameras: Sequence[Camera], photos: Path) -> list[PrintedPatches]:
    """The patches of all markers or of the card in the photos `photos/<name>.png` of `cameras`. Raises BadInputError for none."""
    found = _cells(white, cameras, photos) if white.kind == "markers" else _card(cameras, photos)
    if not found:
        what = "no printed marker" if white.kind == "markers" else "no colour card of 24 patches"
        raise BadInputError(f"bake: --white {white.text} is set, but {what} is seen in {MIN_PHOTOS} photos or more; name a patch instead.")
    return found


def _cells(white: PrintedWhite, cameras: Sequence[Camera], photos: Path) -> list[PrintedPatches]:
    """The middles of the white cells of each marker."""
    name, markers = find_markers(cameras, photos)
    found = []
    for marker in markers:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])
        cells = dictionary.markerSize + 2  # with its black border
        row, column = np.nonzero(cv2.aruco.generateImageMarker(dictionary, marker.number, cells) > 0)
        u, v = (column[:, None] + 0.5) / cells, (row[:, None] + 0.5) / cells
        a, b, c, d = marker.corners
        points = (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d
        reflectance = np.full(len(points), white.reflectance)
        spacing = float(marker.sides.mean()) / cells
        found.append(PrintedPatches(f"marker {marker.number}", points, _towards(marker.corners, cameras), reflectance, spacing))
    return found


def _card(cameras: Sequence[Camera], photos: Path) -> list[PrintedPatches]:
    """The grey patches of the card."""
    views = [view for camera in cameras if (view := _patch_rays(camera, photos)) is not None]
    found = triangulate_together(views, CARD_NOISE, MAX_CARD_RESIDUAL, MIN_PHOTOS)
    if found is None:
        return []
    patches, _ = found
    greys = patches[FIRST_GREY : FIRST_GREY + len(GREYS)]
    spacing = float(np.linalg.norm(np.diff(patches[FIRST_GREY:], axis=0), axis=1).mean())
    return [PrintedPatches("card", greys, _towards(patches, cameras), np.array(GREYS), spacing)]


def _patch_rays(camera: Camera, photos: Path) -> list[Ray] | None:
    """Rays through the middles of the card's patches in one photo; None where it shows none."""
    photo = cv2.imread(str(photos / f"{camera.name}.png"), cv2.IMREAD_COLOR)
    if photo is None:
        raise FileNotFoundError(photos / f"{camera.name}.png")
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(photo, 1):
        return None
    corners: NDArray[np.float64] = np.asarray(detector.getBestColorChecker().getColorCharts(), np.float64).reshape(-1, 4, 2)
    return camera_rays(camera, corners.mean(1)) if len(corners) == PATCHES else None


def _towards(points: Array, cameras: Sequence[Camera]) -> Array:
    """The normal (3,) of the plane through `points` (n, 3), on the side of most cameras."""
    middle = points.mean(0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    sides = [float((camera.centre - middle) @ normal) > 0 for camera in cameras]
    return np.asarray(normal if 2 * sum(sides) >= len(sides) else -normal)
