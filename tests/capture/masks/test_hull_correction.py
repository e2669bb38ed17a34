"""Pieces that single masks lack or have too much are mended by the hull of all; what has the background's colours stays empty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.masks.hull_correction import apply_correction, correct_by_hull
from gsbake.capture.photos.undistortion import undistort_points
from gsbake.geometry.cameras import Camera
from tests.support.cameras import look_at

COUNT, SIZE, MAJOR, MINOR = 40, 200, 0.6, 0.25


def ring(**changes: Any) -> list[Camera]:
    """Cameras around the origin on three heights."""
    cameras = []
    for i in range(COUNT):
        a, h = 2 * np.pi * 0.381966 * i, np.radians(10 + 70 * i / COUNT)
        eye = 4 * np.array([np.cos(a) * np.cos(h), np.sin(a) * np.cos(h), np.sin(h)])
        cameras.append(replace(look_at(eye, size=SIZE, focal=375), name=f"p{i:02}", **changes))
    return cameras


def torus_mask(camera: Camera) -> np.ndarray:
    """Silhouette of a lying torus in the photo with its distortion, by rays whose samples come near the torus' circle."""
    x = (np.arange(SIZE) + 0.5 - camera.cx) / camera.fx
    plane = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    if camera.distortion:
        plane = undistort_points(plane, camera.distortion)
    rays = np.column_stack([plane, np.ones(len(plane))]) @ camera.R
    nearest = np.linalg.norm(np.cross(rays, camera.centre), axis=1) / np.linalg.norm(rays, axis=1)
    left = np.flatnonzero(nearest < MAJOR + MINOR)  # the others miss the ball around the torus
    mask = np.zeros((SIZE, SIZE), np.uint8)
    for depth in np.linspace(3, 5, 61):
        p = camera.centre + depth * rays[left]
        inside = (np.hypot(p[:, 0], p[:, 1]) - MAJOR) ** 2 + p[:, 2] ** 2 < MINOR**2
        mask.flat[left[inside]] = 255
        left = left[~inside]
    return mask


def photo_of(truth: np.ndarray) -> Callable[[], np.ndarray]:
    """Reads a photo: a reddish object with noise before a grey background."""
    noise = np.random.default_rng(0).integers(0, 30, (*truth.shape, 3))
    photo = (np.where(truth[..., None] > 127, [150, 70, 50], [120, 120, 120]) + noise).astype(np.uint8)
    return lambda: photo


def written(folder: Path, masks: dict[str, np.ndarray]) -> dict[str, Path]:
    for name, mask in masks.items():
        cv2.imwrite(str(folder / f"{name}.png"), mask)
    return {name: folder / f"{name}.png" for name in masks}


def test_missing_and_surplus_pieces_are_mended(tmp_path: Path) -> None:
    cameras = ring()
    truth = {c.name: torus_mask(c) for c in cameras}
    guesses = {name: mask.copy() for name, mask in truth.items()}
    rows, columns = np.nonzero(truth["p30"])
    left = columns.argmin()
    cv2.circle(guesses["p30"], (int(columns[left]) + 11, int(rows[left])), 8, 0, -1)  # a piece of the ring
    cv2.rectangle(guesses["p11"], (6, 125), (44, 162), 255, -1)  # a piece of the table
    found = correct_by_hull(cameras, written(tmp_path, guesses))
    for name in truth:
        mended = apply_correction(guesses[name], photo_of(truth[name]), *found[name]) > 127
        wrong = np.count_nonzero(mended != (truth[name] > 127)) / np.count_nonzero(truth[name])
        before = np.count_nonzero(guesses[name] != truth[name]) / np.count_nonzero(truth[name])
        if name in ("p30", "p11"):
            assert before > 0.01 and wrong < 0.25 * before, (name, before, wrong)
        else:
            assert before == 0 and wrong < 0.003, name
    hole = truth["p39"][SIZE // 2, SIZE // 2]
    assert hole == 0 and apply_correction(guesses["p39"], photo_of(truth["p39"]), *found["p39"])[SIZE // 2, SIZE // 2] == 0


def test_a_piece_with_the_colours_of_the_background_is_a_hole() -> None:
    """The same region is filled where the photo shows the object's colours, and left where it shows the background's."""
    disc = np.zeros((SIZE, SIZE), np.uint8)
    cv2.circle(disc, (100, 100), 60, 255, -1)
    pierced = disc.copy()
    cv2.circle(pierced, (110, 90), 15, 0, -1)
    certain, possible = disc > 127, np.ones((SIZE, SIZE), bool)
    assert (apply_correction(pierced, photo_of(disc), certain, possible) == disc).mean() > 0.999
    assert (apply_correction(pierced, photo_of(pierced), certain, possible) == pierced).all()


@pytest.mark.slow
def test_the_correction_is_distorted_as_the_photo(tmp_path: Path) -> None:
    cameras = ring(distortion=(0.15, 0.0, 0.0, 0.0))
    truth = {c.name: torus_mask(c) for c in cameras}
    straight = torus_mask(replace(cameras[20], distortion=()))
    assert np.count_nonzero(straight != truth["p20"]) > 0.01 * np.count_nonzero(straight)
    found = correct_by_hull(cameras, written(tmp_path, truth))
    for name, mask in truth.items():
        assert np.count_nonzero(apply_correction(mask, photo_of(mask), *found[name]) != mask) < 0.003 * np.count_nonzero(mask), name


def test_without_a_common_object_nothing_is_corrected(tmp_path: Path) -> None:
    cameras = ring()
    nothing = {c.name: np.zeros((SIZE, SIZE), np.uint8) for c in cameras}
    assert correct_by_hull(cameras, written(tmp_path, nothing)) == {}
    assert correct_by_hull([replace(c, distortion=(-9.0, 0.0, 0.0, 0.0)) for c in cameras], written(tmp_path, nothing)) == {}
