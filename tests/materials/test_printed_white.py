"""Printed markers and colour cards beside the object: how bright the fitted light is, by what they send."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.white import PrintedWhite, parse_white
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera, CameraSet
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode_bytes, encode_bytes
from gsbake.materials.white import printed_factors
from gsbake.scale.printed_white import GREYS, find_printed
from tests.scale.test_markers import photograph, ring

#: Light, of one radiance everywhere, and what paper sends in the photos.
LIGHT, SENT = np.array([0.8, 0.6, 0.5]), np.array([0.36, 0.42, 0.45])
#: The card's 24 patches, row by row, in sRGB; the last row is grey.
PATCHES = (
    (0x735244, 0xC29682, 0x627A9D, 0x576C43, 0x8580B1, 0x67BDAA), (0xD67E2C, 0x505BA6, 0xC15A63, 0x5E3C6C, 0x9DBC40, 0xE0A32E),
    (0x383D96, 0x469449, 0xAF363C, 0xE7C71F, 0xBB5695, 0x0885A1),
)  # fmt: skip


def ball(at: tuple[float, float, float] = (0.0, 0.0, -9.0)) -> RayCaster:
    """A ball below the ground, which hides nothing, or elsewhere."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return RayCaster(mesh.vertices + at, mesh.faces)


def factors(folder: Path, cameras: list[Camera], text: str, caster: RayCaster, **given: Array) -> list[Array | None]:
    white = parse_white(text)
    assert isinstance(white, PrintedWhite)
    posed = PosedPhotos(folder, CameraSet(tuple(cameras)))
    patches = find_printed(white, cameras, folder / "photos")
    radiance = np.broadcast_to(LIGHT, (6, 8, 8, 3)).astype(np.float32)
    gains = given.get("gains", np.ones((len(cameras), 3)))
    return printed_factors(patches, posed, gains, caster, given.get("radiance", radiance), given.get("rotations"))  # type: ignore[arg-type]


def tint(folder: Path, colour: Array) -> None:
    """Multiply linear photos by a colour."""
    for path in (folder / "photos").iterdir():
        photo = decode_bytes(np.asarray(cv2.imread(str(path)), np.uint8)) * colour[::-1]
        cv2.imwrite(str(path), encode_bytes(photo))


def test_the_paper_of_a_marker(tmp_path: Path) -> None:
    cameras = ring()
    photograph(tmp_path / "photos", cameras, "aruco-4x4", 7)
    tint(tmp_path, SENT)
    (found,) = factors(tmp_path, cameras, "markers", ball())
    assert found == pytest.approx(0.9 * LIGHT / SENT, rel=0.02)
    (found,) = factors(tmp_path, cameras, "markers:0.6", ball(), gains=np.tile([2.0, 1, 1], (len(cameras), 1)))
    assert found == pytest.approx(0.6 * LIGHT / SENT * [2, 1, 1], rel=0.02)
    (shadow,) = factors(tmp_path, cameras, "markers", ball((0.1, 0.9, 0.4)))
    assert shadow is not None and (shadow < 0.97 * 0.9 * LIGHT / SENT).all()  # behind the marker, as the cameras see it


def test_a_light_that_moves(tmp_path: Path) -> None:
    """Bright above in its own frame, where the paper's side up is the x axis."""
    cameras = ring()
    photograph(tmp_path / "photos", cameras, "aruco-4x4", 7)
    tint(tmp_path, SENT)
    radiance = np.zeros((6, 8, 8, 3), np.float32)
    radiance[0] = 1
    up = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    (still,) = factors(tmp_path, cameras, "markers", ball(), radiance=radiance)
    (moved,) = factors(tmp_path, cameras, "markers", ball(), radiance=radiance, rotations=np.tile(up, (len(cameras), 1, 1)))
    assert still is not None and moved is not None and (moved > 2 * still).all()


def test_a_black_light_tells_nothing(tmp_path: Path) -> None:
    cameras = ring()
    photograph(tmp_path / "photos", cameras, "aruco-4x4", 7)
    tint(tmp_path, SENT)
    assert factors(tmp_path, cameras, "markers", ball(), radiance=np.zeros((6, 8, 8, 3), np.float32)) == [None]


def test_clipped_paper_tells_nothing(tmp_path: Path) -> None:
    cameras = ring()
    photograph(tmp_path / "photos", cameras, "aruco-4x4", 7)
    assert factors(tmp_path, cameras, "markers", ball()) == [None]


def test_a_colour_card(tmp_path: Path) -> None:
    """Its greys under a light of its colours; the detector finds it turned and tilted."""
    greys = [encode_bytes(np.full(3, 0.4 * value)) for value in (*GREYS, 0.09, 0.031)]
    patches = [np.array([colour >> 16, colour >> 8 & 255, colour & 255]) for row in PATCHES for colour in row] + greys
    card = np.full((420, 620, 3), 25, np.uint8)
    for k, colour in enumerate(patches):
        row, column = divmod(k, 6)
        card[15 + row * 100 : 105 + row * 100, 15 + column * 100 : 105 + column * 100] = colour[::-1]
    corners = np.array([(-0.62, 0.42, 0), (0.62, 0.42, 0), (0.62, -0.42, 0), (-0.62, -0.42, 0)])
    cameras = [replace(c, width=720, height=540, fx=750.0, fy=750.0, cx=360.0, cy=270.0) for c in ring(4)]
    (tmp_path / "photos").mkdir()
    for camera in cameras:
        at = camera.project(corners)[0].astype(np.float32)
        turn = cv2.getPerspectiveTransform(np.array([(0, 0), (620, 0), (620, 420), (0, 420)], np.float32), at)
        photo = np.full((540, 720, 3), 120, np.uint8)
        cv2.warpPerspective(card, turn, (720, 540), dst=photo, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT)
        cv2.imwrite(str(tmp_path / "photos" / f"{camera.name}.png"), cv2.GaussianBlur(photo, (0, 0), 0.7))
    (found,) = factors(tmp_path, cameras, "card", ball())
    assert found == pytest.approx(LIGHT / 0.4, rel=0.03)


def test_nothing_printed(tmp_path: Path) -> None:
    cameras = ring(3)
    (tmp_path / "photos").mkdir()
    for camera in cameras:
        cv2.imwrite(str(tmp_path / "photos" / f"{camera.name}.png"), np.full((360, 480, 3), 120, np.uint8))
    for text, words in (("markers", "no printed marker is seen"), ("card", "no colour card of 24 patches is seen")):
        with pytest.raises(BadInputError, match=words):
            factors(tmp_path, cameras, text, ball())
