"""Targets of a step against the normal equations written out."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.shape_refinement.targets import Targets, add_systems, interpolation, vertex_rows


def test_system_minimises_the_weighted_squares() -> None:
    draw = np.random.default_rng(0)
    rows = interpolation(draw.integers(0, 4, 30), draw.integers(4, 8, 30), draw.random(30), 8)
    targets = Targets(rows, draw.normal(size=30), draw.random(30) + 0.5, np.full(30, 0.7))
    ratio = np.abs(targets.target) / 0.7
    weight = targets.information * np.where(ratio > 1, 1 / ratio, 1)
    matrix, right = targets.system()
    dense = rows.toarray() * np.sqrt(weight)[:, None]
    expected = np.linalg.lstsq(dense, targets.target * np.sqrt(weight), rcond=None)[0]
    assert dense.T @ (dense @ expected) == pytest.approx(right)
    assert matrix.toarray() == pytest.approx(dense.T @ dense)


def test_targets_are_what_is_left() -> None:
    targets = Targets(vertex_rows(np.array([2, 0]), 3), np.array([0.5, 1.0]), np.ones(2), np.ones(2))
    assert targets.moved(np.array([0.25, 9.0, 0.5])).target.tolist() == [0.0, 0.75]
    matrix, right = add_systems([targets, targets], 3)
    assert right.tolist() == [2.0, 0.0, 1.0]
    assert matrix.diagonal().tolist() == [2.0, 0.0, 2.0]
