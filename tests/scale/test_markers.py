"""Printed markers in rendered photos: their size is measured to half a percent, and what is no marker is ignored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode, encode_bytes
from gsbake.scale.markers import DICTIONARIES, find_markers
from tests.support.cameras import look_at

#: Edge of the marker in world units, and its white margin as a share of it.
EDGE, MARGIN, DOTS = 0.4, 0.25, 600


def ring(count: int = 6) -> list[Camera]:
    return [
        look_at((2 * np.cos(a), 2 * np.sin(a), 1.6), size=(480, 360), focal=500.0, name=f"{i}")
        for i, a in enumerate(np.linspace(0, 2, count))
    ]


def photograph(
    folder: Path, cameras: list[Camera], dictionary: str, number: int, at: tuple[float, float] = (0.1, -0.05), brightness: float = 1.0
) -> None:
    """Photos of a marker on the ground, over what the photos already show."""
    folder.mkdir(exist_ok=True)
    image = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]), number, DOTS)
    border = round(MARGIN * DOTS)
    sheet = cv2.copyMakeBorder(image, border, border, border, border, cv2.BORDER_CONSTANT, value=255)
    reach = EDGE * (0.5 + MARGIN)
    ground = np.array([(-1, 1, 0), (1, 1, 0), (1, -1, 0), (-1, -1, 0)]) * reach + (*at, 0)
    dots = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32) * len(sheet) - 0.5
    for camera in cameras:
        pixels, _ = camera.project(ground)
        transform = cv2.getPerspectiveTransform(dots, (pixels - 0.5).astype(np.float32))
        file = folder / f"{camera.name}.png"
        before: Any = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) if file.exists() else None
        photo = np.full((camera.height * 4, camera.width * 4), 128, np.uint8) if before is None else cv2.resize(before, None, fx=4, fy=4)
        # Drawn four times as large and reduced in linear light: sharp edges with the coverage of each pixel.
        larger = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]]) @ transform
        cv2.warpPerspective(sheet, larger, photo.shape[::-1], dst=photo, borderMode=cv2.BORDER_TRANSPARENT)
        light = cv2.resize(decode(photo.astype(np.float32) / 255), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(file), encode_bytes(brightness * light))


@pytest.mark.parametrize("dictionary", ["aruco-4x4", "aruco-original", "apriltag-36h11"])
def test_the_edge_of_a_marker_is_measured(tmp_path: Path, dictionary: str) -> None:
    cameras = ring()
    photograph(tmp_path / "photos", cameras, dictionary, 7)
    found, markers = find_markers(cameras, tmp_path / "photos")
    assert found == dictionary and [marker.number for marker in markers] == [7]
    assert markers[0].photos == 6
    assert abs(markers[0].sides.mean() / EDGE - 1) < 0.002
    truth = np.array([(-1, 1, 0), (1, 1, 0), (1, -1, 0), (-1, -1, 0)]) * EDGE / 2 + (0.1, -0.05, 0)
    assert np.abs(markers[0].corners - truth).max() < 0.002


def test_dark_photos_show_their_marker(tmp_path: Path) -> None:
    cameras = ring()
    photograph(tmp_path / "photos", cameras, "aruco-4x4", 7, brightness=0.02)
    (marker,) = find_markers(cameras, tmp_path / "photos")[1]
    assert abs(marker.sides.mean() / EDGE - 1) < 0.004


def test_markers_that_move_or_are_seen_twice_are_left_out(tmp_path: Path) -> None:
    cameras = ring()
    for i, camera in enumerate(cameras):
        photograph(tmp_path / "photos", [camera], "aruco-5x5", 1, (-0.6, 0.0))
        photograph(tmp_path / "photos", [camera], "aruco-5x5", 2, (0.1 * i, 0.55 - 0.1 * i))  # does not stay where it is
    for at in ((0.3, -0.6), (-0.3, -0.6)):
        photograph(tmp_path / "photos", cameras, "aruco-5x5", 3, at)
    found, markers = find_markers(cameras, tmp_path / "photos")
    assert found == "aruco-5x5" and [marker.number for marker in markers] == [1]


def test_photos_without_markers(tmp_path: Path) -> None:
    rng, cameras = np.random.default_rng(0), ring(4)
    for camera in cameras:
        cells = rng.integers(0, 2, (30, 40), np.uint8) * 255
        tmp_path.joinpath("photos").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "photos" / f"{camera.name}.png"), cv2.resize(cells, (480, 360), interpolation=cv2.INTER_NEAREST))
    assert find_markers(cameras, tmp_path / "photos")[1] == []
