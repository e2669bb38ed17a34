"""The benchmark of what a field's distance does: true distances of a ball, correlation, shift of depth, stopping, and its table."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.distance import Row, StopAt, correlation, depth_shift, true_distances
from benchmarks.fields import KEY, write
from benchmarks.truth import Surface
from gsbake.errors import InterruptedRun
from gsbake.geometry.cameras import Similarity
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from tests.support.cameras import look_at

RADIUS = 0.6


def shell(offset: float, count: int = 1500) -> Surfels:
    """Surfels within ±`offset` of a ball, with their distances from it as samples."""
    p = fibonacci_sphere(count)
    s = create(RADIUS * p, p, RADIUS * spacing(p), None, "colour", 0, 0.0, 100.0)
    s.sdf = offset * (2 * torch.rand(count, generator=torch.Generator().manual_seed(0)) - 1)
    s.position = s.position + s.sdf[:, None] * s.normal()
    return s


def posed(frame: Similarity | None = None) -> Any:
    cameras = [look_at(eye, size=40, focal=50.0, name=f"{i}") for i, eye in enumerate(2.5 * fibonacci_sphere(4))]
    return SimpleNamespace(cameras=SimpleNamespace(cameras=cameras, to_world=frame or Similarity()))


def ball(scale: float = 1.0) -> Surface:
    mesh = trimesh.creation.icosphere(5, RADIUS * scale)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_true_distances_are_signed() -> None:
    points = fibonacci_sphere(200) * np.linspace(0.5, 0.7, 200)[:, None]
    assert np.allclose(true_distances(points, ball()), np.linspace(-0.1, 0.1, 200), atol=2e-3)


def test_correlation_in_any_frame() -> None:
    true = shell(0.02)
    frame = Similarity(3.0, np.eye(3), np.zeros(3))
    assert correlation(true, posed(frame), ball(3.0)) > 0.99
    assert correlation(replace(true, sdf=-true.sdf), posed(), ball()) < -0.99
    assert correlation(replace(true, sdf=torch.full_like(true.sdf, 0.01)), posed(), ball()) == 0


def test_depth_moves_where_the_distance_makes_surfels_transparent() -> None:
    thick, size = shell(0.06), 40
    assert depth_shift(thick, posed(), [0, 1], size, projected=True, cell=0.01) > 0.5
    opaque = replace(thick, sdf=torch.zeros_like(thick.sdf))
    assert depth_shift(opaque, posed(), [0, 1], size, projected=True, cell=0.01) == 0


def test_a_run_stops_at_its_share() -> None:
    stop = StopAt(0.5)
    stop.progress(4, 10)
    assert not stop.stop_requested()
    stop.progress(5, 10)
    assert stop.stop_requested()
    with pytest.raises(InterruptedRun):
        stop.check_stop()
    whole = StopAt(1.0)
    whole.progress(10, 10)
    assert not whole.stop_requested()


def test_rows_replace_those_of_the_same_stop(tmp_path: Path) -> None:
    row = Row("built-in", "dsdf", "", 0, 0.5, 1.0, 0.8, 0.7, 1.5, 100, "densified: 3")
    key = (*KEY, "share")
    write(tmp_path / "rows.csv", [row, replace(row, share=1.0)], key)
    write(tmp_path / "rows.csv", [replace(row, shift=2.0)], key)
    with (tmp_path / "rows.csv").open(newline="") as file:
        found = {line["share"]: line["shift"] for line in csv.DictReader(file)}
    assert found == {"0.5": "2.0", "1.0": "1.0"}
