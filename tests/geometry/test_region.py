"""The region: what lies in the box, where photos show it, and its file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Similarity
from gsbake.geometry.region import EDGES, Region
from tests.support.cameras import look_at

TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
BOX = Region(np.array([0.2, -0.1, 0.3]), np.array([1.0, 0.4, 0.6]), TURN)


def test_what_lies_in_a_turned_box() -> None:
    local = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    points = BOX.centre + local @ TURN.T
    inside = (np.abs(local) <= BOX.size / 2).all(1)
    assert np.array_equal(BOX.contains(points), inside) and 10 < inside.sum() < 400
    nearest = np.clip(local, -BOX.size / 2, BOX.size / 2)
    np.testing.assert_allclose(BOX.distance(points)[~inside], np.linalg.norm(local - nearest, axis=1)[~inside])
    np.testing.assert_allclose(BOX.clamped(points), BOX.centre + nearest @ TURN.T)
    assert np.array_equal(BOX.clamped(points)[inside], points[inside])
    assert BOX.distance(BOX.centre) == pytest.approx(-0.2)  # half the shortest edge
    frame = Similarity(2.5, TURN.T, np.array([1.0, 2, 3]))
    assert np.array_equal(BOX.moved(frame).contains(frame.apply(points)), inside)


def test_edges_join_corners_along_one_axis() -> None:
    lengths = [np.linalg.norm(BOX.corners[a] - BOX.corners[b]) for a, b in EDGES]
    assert len(EDGES) == 12 and np.allclose(np.sort(lengths), np.repeat(np.sort(BOX.size), 4))


def test_photos_show_the_box_where_rays_meet_it() -> None:
    camera = look_at((2.0, 1.0, 1.5), target=(0.4, 0, 0.2), size=(120, 90), focal=110.0)
    along = np.linspace(0.2, 6, 600)
    seen = np.array([BOX.contains(camera.centre + along[:, None] * ray).any() for ray in camera.rays().reshape(-1, 3)])
    shown = BOX.silhouette(camera).ravel() == 255
    assert shown[seen].all() and seen.sum() < shown.sum() < 1.1 * seen.sum()  # pixels that it touches count too
    assert not BOX.silhouette(look_at((2.0, 1.0, 1.5), target=(4.0, 4, 1), size=64)).any()
    assert BOX.silhouette(look_at((0.2, -0.1, 0.3), target=(4.0, 4, 1), size=64)).all()  # from inside


def test_its_file_comes_back_and_what_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    path.write_text(json.dumps(BOX.document))
    assert np.allclose(Region.read(path).numbers, BOX.numbers)
    path.write_text('{"centre": [0, 0, 1], "size": [1, 2, 3]}')
    assert np.array_equal(Region.read(path).rotation, np.eye(3))
    for text, message in (
        ("box", "is no region"),
        ("[1]", "is no region"),
        ('{"centre": [0, 0, 1]}', "is no region"),
        ('{"centre": [0, 0, 1], "size": [1, 2, -3]}', "is no box"),
        ('{"centre": [0, 0, NaN], "size": [1, 2, 3]}', "is no box"),
        ('{"centre": [0, 0, 1e300], "size": [1, 2, 3]}', "is no box"),
        ('{"centre": [0, 0, 1], "size": [1, 2, 1e-320]}', "is no box"),
        (f'{{"centre": [0, 0, 1{400 * "0"}], "size": [1, 2, 3]}}', "is no region"),
        ('{"centre": [0, 0, 1, 1], "size": [2, 3]}', "is no region"),
        ('{"centre": [0, 0, 1], "size": [1, 2, 3], "rotation": [[1e200,0,0],[0,1e200,0],[0,0,1]]}', "is no box"),
        ('{"centre": [0, 0, 1], "size": [1, 2, 3], "rotation": [[1,0,0],[0,1,0],[0,0,-1]]}', "scales, shears or mirrors"),
    ):
        path.write_text(text)
        with pytest.raises(BadInputError, match=message):
            Region.read(path)
    with pytest.raises(BadInputError, match="cannot be read"):
        Region.read(tmp_path / "none.json")
