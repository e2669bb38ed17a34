"""Hard and soft parts of a hull: a ball's surface is hard, the lid over a bowl and the side that no photo sees along are soft."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from gsbake.capture.hull.softness import BALL_DEPTH, LONGEST_CHORD, SOFT, shortest_chords, surface_softness
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from tests.support.cameras import look_at

Points = NDArray[np.float64]
SIZE, DISTANCE, CELLS = 200, 4.0, 64


def camera(direction: Points, name: str) -> Camera:
    return look_at(DISTANCE * direction / np.linalg.norm(direction), size=(SIZE, SIZE), focal=360.0, name=name)


def around(elevation: float, count: int = 24) -> list[Camera]:
    """Cameras on a circle at an elevation in degrees."""
    e = np.radians(elevation)
    turns = 2 * np.pi * np.arange(count) / count
    return [camera(np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]), f"{i:02d}") for i, a in enumerate(turns)]


def mask(one: Camera, cells: Points, radius: float) -> NDArray[np.uint8]:
    """Silhouette of small balls at `cells`."""
    import cv2

    out = np.zeros((SIZE, SIZE), np.uint8)
    pixel, depth = one.project(cells)
    for (x, y), z in zip(pixel, depth, strict=True):
        cv2.circle(out, (round(16 * (x - 0.5)), round(16 * (y - 0.5))), round(16 * radius * one.fx / z), 255, -1, cv2.LINE_8, 4)
    return out


def grid() -> tuple[Points, float]:
    cell = 2 / CELLS
    axis = (np.arange(CELLS) + 0.5) * cell - 1
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), cell


def test_chords_of_a_ball_follow_the_formula() -> None:
    """Pythagoras: a ray that passes d below the surface of a ball of radius r has a chord of 2 √(2 r d − d²)."""
    cells, cell = grid()
    radius = 0.6
    field = (np.linalg.norm(cells, axis=-1) - radius).astype(np.float32)
    hull = Hull(field < 0, np.full(3, -1.0), cell, field)
    view = camera(np.array([1.0, 0.2, 0.1]), "a")
    toward = view.centre / DISTANCE
    aside = np.cross(toward, [0, 0, 1.0])
    aside /= np.linalg.norm(aside)
    # Where the ray of the camera has its midpoint: on the sphere over the segment from the camera to the ball's centre (Thales).
    below = np.array([0.3, 0.6, 0.9]) * cell
    reach = radius - below
    points = (reach**2 / DISTANCE)[:, None] * toward + (reach * np.sqrt(1 - (reach / DISTANCE) ** 2))[:, None] * aside
    index = np.floor((points + 1) / cell).astype(np.int64)
    centres = (index + 0.5) * cell - 1
    to = centres - view.centre
    passes = np.linalg.norm(np.cross(to, view.centre), axis=1) / np.linalg.norm(to, axis=1)  # distance of the ray from the centre
    expected = 2 * np.sqrt(np.maximum(radius**2 - passes**2, 0)) / cell
    found = shortest_chords(index, hull, [view], [mask(view, np.zeros((1, 3)), radius)])
    inside = passes < radius - 0.3 * cell
    assert inside.sum() >= 2
    assert found[inside] == pytest.approx(expected[inside], abs=2.5)


def test_photos_without_an_edge_leave_everything_soft() -> None:
    cells, cell = grid()
    field = (np.linalg.norm(cells, axis=-1) - 0.5).astype(np.float32)
    hull = Hull(field < 0, np.full(3, -1.0), cell, field)
    views = around(20.0, 3)
    index = np.argwhere(hull.occupancy)[:10]
    full = [np.full((SIZE, SIZE), 255, np.uint8)] * 3
    assert (shortest_chords(index, hull, views, full) == LONGEST_CHORD).all()
    assert (surface_softness(hull, views, full) > SOFT).all()


def test_a_ball_is_hard() -> None:
    views = [one for elevation in (-50, -15, 15, 50, 89) for one in around(elevation, 12)]
    hull = Hull.from_masks(views, [mask(v, np.zeros((1, 3)), 0.6) for v in views], np.zeros(3), 1.0, CELLS)
    softness = surface_softness(hull, views, [mask(v, np.zeros((1, 3)), 0.6) for v in views])
    assert np.median(softness[hull.occupancy]) == pytest.approx(1.0, abs=0.4) and BALL_DEPTH < 1
    assert (softness[hull.occupancy] < SOFT).mean() > 0.9


def test_the_lid_of_a_bowl_is_soft_and_its_outside_hard() -> None:
    """Half a ball, hollow, photographed from 35 degrees above: the hull closes it by a cone."""
    cells, cell = grid()
    r = np.linalg.norm(cells, axis=-1)
    shell = cells[(r < 0.6) & (r > 0.52) & (cells[..., 2] < 0)]
    views = [one for elevation in (-40, -10, 35, 60) for one in around(elevation, 18)]
    masks = [mask(v, shell, cell) for v in views]
    hull = Hull.from_masks(views, masks, np.zeros(3), 1.0, CELLS)
    softness = surface_softness(hull, views, masks)
    solid = hull.occupancy
    z, across = cells[..., 2], np.linalg.norm(cells[..., :2], axis=-1)
    surface = solid & (hull.field > -cell)
    lid, outside = surface & (across < 0.35) & (z > 0), surface & (z < -0.1)
    assert lid.sum() > 50 and (softness[lid] > SOFT).mean() > 0.9
    assert (softness[outside] < SOFT).mean() > 0.8
