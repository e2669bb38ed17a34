"""Shares of hollows that are open: a block with a pit, closed, open, and opened too far."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from benchmarks.hollows import main, seen_past, shares
from benchmarks.truth import Surface
from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from tests.support.cameras import look_at


def block(pit: float = 0.0, cells: int = 48) -> Hull:
    """A cube of edge .8 with a square pit of width .4 and this depth in its upper face."""
    axis = (np.arange(cells) + 0.5) * 2 / cells - 1
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    field = np.maximum.reduce([np.abs(x), np.abs(y), np.abs(z)]) - 0.4
    hole = np.maximum.reduce([np.abs(x) - 0.2, np.abs(y) - 0.2, 0.4 - pit - z])
    field = np.maximum(field, -hole) if pit else field
    return Hull(field < 0, np.full(3, -1.0), 2 / cells, field.astype(np.float32))


def cameras() -> list[Camera]:
    turn = 2.4 * np.arange(16)
    low = np.linspace(0.3, 0.98, 16)
    eyes = 4.0 * np.stack([np.sqrt(1 - low**2) * np.cos(turn), np.sqrt(1 - low**2) * np.sin(turn), low], 1)
    return [look_at(eye, size=200, focal=400.0, name=f"{k}") for k, eye in enumerate(eyes)]


def surface(hull: Hull) -> Surface:
    return Surface(*hull.triangles())


def test_a_pit() -> None:
    truth = surface(block(0.4))
    closed, half, whole, deep = shares([surface(block(p)) for p in (0.0, 0.2, 0.4, 0.6)], block(), truth, cameras())
    assert closed == (pytest.approx(0, abs=0.02), 0)
    assert 0.3 < half[0] < 0.7 and half[1] == 0
    assert whole == (pytest.approx(1, abs=0.02), pytest.approx(0, abs=0.002))
    # The pit that is too deep adds half of the pit to the wrong: .4·.4·.2 of .8³ − .4·.4·.4, of which cameras see the most.
    assert deep[0] > 0.98 and 0.02 < deep[1] < 0.032 / (0.512 - 0.064) + 0.01


def test_cameras_see_past_a_point_before_the_surface_only() -> None:
    ball = trimesh.creation.icosphere(3, 0.5)
    points = np.array([[0.0, 0.0, 0.6], [0, 0, 0.0], [0, 0, 0.51]])
    views = [look_at(np.array([0.1, 0, 4.0]), size=100, focal=200.0, name="0")]
    shape = Surface(np.asarray(ball.vertices), np.asarray(ball.faces, np.int64))
    assert seen_past(points, shape, views, 0.05).tolist() == [1, 0, 0]


def test_an_odd_number_of_folders_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["somewhere"]) != 0
    assert "run and its capture" in capsys.readouterr().err
