"""Masks from a plane with texture: the plane is found, and what stands on it is separated from it without a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.masks.consensus import intersection_over_union
from gsbake.capture.masks.support_plane import confirmed_pixels, find_object, find_plane, plane_masks, segment
from gsbake.geometry.cameras import Camera
from tests.support.cameras import look_at

COUNT, SIZE = 20, 256
#: A ball of this radius that stands on the plane z = 0.
RADIUS = 0.5


def ring(tilt: float = 0.0) -> list[Camera]:
    """Cameras around the ball at two heights; `tilt` leans the world."""
    cameras = []
    for i in range(COUNT):
        azimuth, elevation = 2.4 * i, np.radians(30 + 35 * (i % 2))
        eye = 4 * np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]) + (0, 0, RADIUS)
        camera = look_at(eye, (0.0, 0.0, RADIUS), size=SIZE, focal=1.4 * SIZE)
        cameras.append(replace(camera, name=f"p{i:02}"))
    turn = cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))[0]
    return [replace(c, R=c.R @ turn.T) for c in cameras]


def photograph(camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A photo of a mirror-like ball, whose colours depend on the view, on a patterned plane; and its mask."""
    rng = np.random.default_rng(4)
    pattern = cv2.resize(rng.integers(20, 230, (64, 64, 3)).astype(np.uint8), (512, 512), interpolation=cv2.INTER_CUBIC)
    u, v = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1) @ camera.R
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye, centre = camera.centre, np.array([0, 0, RADIUS])
    middle = rays @ (centre - eye)
    mask = ((centre - eye) @ (centre - eye) - middle**2 < RADIUS**2) & (middle > 0)
    ground = eye + (-eye[2] / np.minimum(rays[..., 2:], -1e-6)) * rays
    columns, rows = (np.ascontiguousarray(256 + 60 * ground[..., k], np.float32) for k in (0, 1))
    photo = cv2.remap(pattern, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    ball = cv2.resize(np.random.default_rng(int(1e6 * abs(eye[0]))).integers(0, 90, (9, 9, 3)).astype(np.uint8), (SIZE, SIZE))
    ball[..., 2] += 140
    return np.asarray(np.where(mask[..., None], ball, photo), np.uint8), mask


@pytest.fixture(scope="module")
def capture() -> tuple[list[Camera], list[NDArray[np.uint8]], list[NDArray[np.bool_]]]:
    """Cameras, photos and true masks."""
    cameras = ring()
    shots = [photograph(camera) for camera in cameras]
    return cameras, [photo for photo, _ in shots], [mask for _, mask in shots]


def ground_points(count: int = 400) -> Any:
    points = np.random.default_rng(0).uniform(-2, 2, (count, 3))
    points[:, 2] = 0
    return points


def test_the_plane_is_found_among_other_points() -> None:
    cameras = ring()
    above = np.random.default_rng(1).normal(0, 0.3, (200, 3)) + (0, 0, 0.9)
    plane = find_plane(np.concatenate([ground_points(), above]), cameras, 0)
    assert plane is not None
    np.testing.assert_allclose(plane.normal, (0, 0, 1), atol=1e-6)
    assert plane.offset == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("points", ["a cloud", "few", "a plane with points behind it"])
def test_no_plane(points: str) -> None:
    """No plane is better than a wrong one."""
    cloud = np.random.default_rng(1).normal(0, 0.8, (400, 3))
    behind = np.concatenate([ground_points(), np.random.default_rng(2).uniform(-1, 1, (200, 3)) - (0, 0, 1.5)])
    given = {"a cloud": cloud, "few": ground_points(20), "a plane with points behind it": behind}[points]
    assert find_plane(given, ring(), 0) is None


def test_pixels_of_the_plane_are_confirmed_and_the_ball_is_not(capture: Any) -> None:
    cameras, photos, masks = capture
    plane = find_plane(ground_points(), cameras, 0)
    assert plane is not None
    greys = [cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY).astype(np.float32) for photo in photos]
    pixels = confirmed_pixels(cameras, greys, plane)
    window = np.ones((9, 9), np.uint8)  # at the border of the ball it holds both
    on_ball, on_plane = [], []
    for mask, (decided, confirmed) in zip(masks, pixels, strict=True):
        on_ball.append(confirmed[cv2.erode(mask.astype(np.uint8), window) > 0])
        on_plane.append(confirmed[decided & (cv2.dilate(mask.astype(np.uint8), window) == 0)])
    assert np.concatenate(on_ball).mean() < 0.1 and np.concatenate(on_plane).mean() > 0.9
    found = find_object(cameras, pixels, plane)
    assert found is not None
    assert np.median([intersection_over_union(m, s) for m, s in zip(masks, found.silhouettes, strict=True)]) > 0.75
    for camera, mask, below in zip(cameras, masks, found.below, strict=True):  # the shadow of a light from above
        centre = camera.project(np.zeros((1, 3)))[0][0]
        assert below[int(centre[1]), int(centre[0])] and 0.2 < below.sum() / mask.sum() < 1.4


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_masks_of_what_stands_on_it(capture: Any, tmp_path: Path, tilt: float) -> None:
    """Guesses that found nothing do no harm; the frame of the world does not matter."""
    cameras, photos, masks = ring(tilt), capture[1], capture[2]
    turn = cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))[0]
    files: dict[str, dict[str, Path]] = {"photos": {}, "guesses": {}}
    for camera, photo in zip(cameras, photos, strict=True):
        for kind, image in (("photos", photo), ("guesses", np.zeros((SIZE, SIZE), np.uint8))):
            (tmp_path / kind).mkdir(exist_ok=True)
            files[kind][camera.name] = tmp_path / kind / f"{camera.name}.png"
            cv2.imwrite(str(files[kind][camera.name]), image)
    points = ground_points() @ turn.T
    found = plane_masks(cameras, files["photos"], files["guesses"], points, tmp_path / "masks", 0, 2)
    assert len(found) == 2
    for files_of_set in found:
        assert list(files_of_set) == [camera.name for camera in cameras]
        overlap = []
        for mask, path in zip(masks, files_of_set.values(), strict=True):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert image is not None and image.shape == mask.shape
            overlap.append(intersection_over_union(image > 127, mask))
        assert np.median(overlap) > 0.93 and min(overlap) > 0.85


def test_small_holes_are_filled_and_large_ones_stay() -> None:
    """Colour decides inside the silhouette; specks of the background's colour are the object's."""
    photo = np.full((120, 160, 3), (40, 160, 60), np.uint8)
    photo[30:90, 40:120] = (30, 40, 200)
    photo[50:52, 60:62] = photo[45:70, 80:105] = (40, 160, 60)
    silhouette = np.zeros((120, 160), bool)
    silhouette[27:93, 37:123] = True
    nowhere = np.zeros_like(silhouette)
    found = segment(photo, silhouette, nowhere, nowhere)
    assert found[50:52, 60:62].all() and not found[50:65, 85:100].any()
    assert found[32:44, 42:118].all() and not found[:24].any()


def test_a_foot_of_the_same_colour_joins_where_it_is_possible() -> None:
    photo = np.full((120, 160, 3), (40, 160, 60), np.uint8)
    photo[30:90, 60:100] = photo[90:98, 30:130] = (30, 40, 200)
    silhouette, below = np.zeros((120, 160), bool), np.zeros((120, 160), bool)
    silhouette[28:90, 58:102] = True
    below[84:104, 26:134] = True
    nowhere = np.zeros_like(silhouette)
    assert not segment(photo, silhouette, nowhere, nowhere)[92:96, 34:50].any()
    found = segment(photo, silhouette, nowhere, below)
    assert found[92:96, 34:50].all() and not found[100:].any() and not found[84:89, 26:56].any()


def test_what_fills_the_photos_is_not_an_object(capture: Any) -> None:
    """Pixels that the plane explains nowhere, as of a room that turns against it, would be a mask of everything."""
    cameras, plane = capture[0], find_plane(ground_points(), capture[0], 0)
    assert plane is not None
    everything = np.ones((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)
    assert find_object(cameras, [everything] * COUNT, plane) is None
    nothing = np.ones((SIZE, SIZE), bool), np.ones((SIZE, SIZE), bool)
    assert find_object(cameras, [nothing] * COUNT, plane) is None
