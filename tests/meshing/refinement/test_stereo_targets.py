"""Displacements to stereo's depths: spheres of known size, depths that most photos lack, and depths of another surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gsbake.meshing.refinement import shape
from gsbake.meshing.refinement.shape import TARGETS_ONLY, ShapeRefinement
from gsbake.meshing.refinement.stereo_targets import StereoTargets
from gsbake.monitor import SILENT
from gsbake.shape_refinement.step import solve_step
from gsbake.shape_refinement.surface import Surface
from gsbake.shape_refinement.targets import Targets, contour_targets
from tests.meshing.scenes import cameras_around
from tests.mvs.scenes import RADIUS, sphere_depth

Floats = NDArray[np.float32]
CAMERAS = cameras_around(each=8, size=200)
#: Size of a pixel on the part of the sphere that faces a camera.
PIXEL = (3 - RADIUS) / CAMERAS[0].fx


def depths(factor: float = 1.0) -> list[Floats]:
    """Depths of the sphere in all photos, at that multiple of its size in pixels."""
    return [
        sphere_depth(camera.scaled(round(camera.width * factor), round(camera.height * factor))).astype(np.float32) for camera in CAMERAS
    ]


def sphere(error: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A sphere `error` pixels too large, with dents of half as much."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    way = np.asarray(ball.vertices)
    dents = np.sin(7 * way[:, 0]) * np.sin(6 * way[:, 1] + 1) * np.cos(8 * way[:, 2])
    return way * (RADIUS + error * PIXEL * (1 + 0.5 * dents))[:, None], np.asarray(ball.faces, np.int32)


def measured(maps: Sequence[Floats | None], vertices: Any, surface: Surface) -> tuple[Targets, float]:
    found: Callable[[int], Any] = lambda index: None if (depth := maps[index]) is None else (depth, np.ones_like(depth))  # noqa: E731
    return StereoTargets(CAMERAS, found, 6 * PIXEL, PIXEL, 1)(surface, vertices)


@pytest.mark.parametrize(("factor", "error"), [(1.0, 0.8), (1.0, -0.8), (0.6, 0.8)])
def test_the_surface_comes_to_the_depths(factor: float, error: float) -> None:
    """Also where depths have fewer pixels than the photos."""
    vertices, faces = sphere(error)
    surface, maps = Surface(len(vertices), faces), depths(factor)
    for _ in range(TARGETS_ONLY.first_steps):
        targets, share = measured(maps, vertices, surface)
        step = solve_step(surface, vertices, PIXEL, [targets], TARGETS_ONLY.first)
        vertices = vertices + step[:, None] * surface.normals(vertices)
    seen = np.abs(vertices[:, 2]) < 0.6 * RADIUS
    rest = np.abs(np.linalg.norm(vertices, axis=1)[seen] - RADIUS) / PIXEL
    assert share > 0.95
    assert np.median(rest) < 0.05 and np.quantile(rest, 0.95) < 0.15


def test_masks_that_are_too_large_hardly_move_what_stereo_confirms() -> None:
    """Masks of a sphere that is a pixel larger: as the photos of it would show it from nearer by."""
    vertices, faces = sphere(0.0)
    surface = Surface(len(vertices), faces)
    nearer = [replace(camera, t=camera.t / (1 + PIXEL / RADIUS)) for camera in CAMERAS]
    masks = [(camera, np.where(sphere_depth(at) > 0, 255, 0).astype(np.uint8)) for camera, at in zip(CAMERAS, nearer, strict=True)]
    drawn, offset = contour_targets(surface, vertices, masks, 1)
    alone = solve_step(surface, vertices, PIXEL, [drawn], TARGETS_ONLY.first)
    held = solve_step(surface, vertices, PIXEL, [drawn, measured(depths(), vertices, surface)[0]], TARGETS_ONLY.first)
    assert offset > 0.5 and np.median(alone) > 0.5 * PIXEL
    assert abs(np.median(held)) < 0.3 * np.median(alone)


def test_depths_count_by_majority_and_near_the_surface() -> None:
    vertices, faces = sphere(0.0)
    surface, maps = Surface(len(vertices), faces), depths()
    few: list[Floats | None] = [depth if k % 3 == 0 else None for k, depth in enumerate(maps)]
    targets, share = measured(few, vertices, surface)
    assert share < 0.2 and (targets.information > 0).mean() < 0.5
    far: list[Floats | None] = [np.where(depth > 0, depth + 7 * PIXEL, 0).astype(np.float32) for depth in maps]
    targets, share = measured(far, vertices, surface)
    assert share == 0 and len(targets.target) == 0
    assert measured([None] * len(CAMERAS), vertices, surface)[1] == 0
    assert measured(maps, 0 * vertices, surface)[1] == 0  # a collapsed mesh


def test_a_mesh_is_refined_by_the_depths_on_the_disk(tmp_path: Path) -> None:
    vertices, faces = sphere(0.8)
    (tmp_path / "depth").mkdir()
    for camera, depth in zip(CAMERAS, depths(), strict=True):
        np.savez(tmp_path / "depth" / f"{camera.name}.npz", depth=depth, confidence=np.ones(depth.shape, np.float16))
    masks = [np.where(depth > 0, 255, 0).astype(np.uint8) for depth in depths()]
    posed = SimpleNamespace(has_masks=True, mask=lambda index: (CAMERAS[index], masks[index]))
    photos: Any = SimpleNamespace(posed=posed, camera=lambda index, size: CAMERAS[index])
    run = ShapeRefinement(photos, range(len(CAMERAS)), tmp_path, 6 * PIXEL, 5000, "fast-simplification", 0, 1, SILENT)
    moved, figures = run.refine(vertices, faces, 100, 200)
    assert figures["refinement_confirmed"] > 0.95
    assert np.median(np.abs(np.linalg.norm(moved, axis=1) - RADIUS)) < 0.15 * PIXEL


@pytest.mark.parametrize(("finer", "confirmed", "sizes"), [(480, 0.9, [480]), (1500, 0.9, [1500]), (1500, 0.1, [1500, 480])])
def test_larger_photos_are_used_where_stereo_confirms_the_surface(
    monkeypatch: pytest.MonkeyPatch, finer: int, confirmed: float, sizes: list[int]
) -> None:
    tried: list[tuple[int, bool]] = []

    def refine_at(self: Any, size: int, vertices: Any, faces: Any, by_stereo: bool) -> Any:
        tried.append((size, by_stereo))
        return vertices + size, "", {"confirmed": confirmed, "moved_pixels": 0.0}

    monkeypatch.setattr(ShapeRefinement, "_refine_at", refine_at)
    run: Any = SimpleNamespace(monitor=SILENT)
    run._refine_at = lambda *a, **k: refine_at(run, *a, **k)
    moved, figures = shape.ShapeRefinement.refine(run, np.zeros((3, 3)), np.zeros((1, 3), np.int32), 480, finer)
    assert tried == [(size, size != 480) for size in sizes]
    assert (moved == sizes[-1]).all() and figures["refinement_confirmed"] == confirmed
