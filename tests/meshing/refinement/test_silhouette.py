"""Silhouette refinement: a sphere of known size is recovered from a smaller one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.meshing.refinement.normals import unique_edges, vertex_normals
from gsbake.meshing.refinement.silhouette import SEARCH_RADIUS, ContourPoints, find_contour_points, refine_silhouettes, solve_displacements
from tests.support.cameras import look_at

Masked = tuple[Camera, NDArray[np.uint8]]


def ring(count: int, size: int = 160) -> list[Camera]:
    """Cameras around the origin at distance 4, at three heights, slightly off centre."""
    cameras = []
    for k in range(count):
        turn, high = 2.4 * k, (-0.5, 0.1, 0.8)[k % 3]
        centre = 4 * np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        cameras.append(look_at(centre, size=(size, size - 20), focal=2.0 * size, name=f"{k}", shift=(3.3, 0.9)))
    return cameras


def masks(mesh: trimesh.Trimesh, cameras: list[Camera], supersampling: int = 4) -> list[Masked]:
    """Coverage of the mesh in each camera with supersampling² rays per pixel."""
    caster = RayCaster(mesh.vertices, mesh.faces, 1)
    out = []
    for camera in cameras:
        hit = caster.depth(camera.scaled(camera.width * supersampling, camera.height * supersampling)) > 0
        cover = hit.reshape(camera.height, supersampling, camera.width, supersampling).mean((1, 3))
        out.append((camera, np.round(255 * cover).astype(np.uint8)))
    return out


def each(views: list[Masked]) -> Iterator[Masked]:
    yield from views


def sphere(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def test_offset_of_a_smaller_sphere_equals_the_analytic_one() -> None:
    camera, mask = masks(sphere(0.5), ring(1), supersampling=8)[0]
    small = sphere(0.48)
    edges = unique_edges(small.faces)
    contour = find_contour_points(RayCaster(small.vertices, small.faces, 1), np.asarray(small.vertex_normals), edges, camera, mask)
    # A sphere of radius r at distance d shows a disc of tan(asin(r / d)); off the axis it is a slightly longer ellipse.
    expected = camera.fx * (np.tan(np.arcsin(0.5 / 4)) - np.tan(np.arcsin(0.48 / 4)))
    assert len(contour) > 100
    assert abs(np.median(contour.offset * contour.pixel) - 0.02) < 0.0015
    assert abs(np.median(contour.offset) - expected) < 0.25


def test_sphere_is_recovered() -> None:
    views = masks(sphere(0.5), ring(12))
    small = sphere(0.48)
    result = refine_silhouettes(np.asarray(small.vertices), np.asarray(small.faces, np.int32), lambda: each(views), 3, 1)
    radius = np.linalg.norm(result.vertices, axis=1)
    assert result.offset_before > 1.5
    assert abs(result.offset_after) < 0.1
    assert abs(radius.mean() - 0.5) < 0.001
    assert radius.std() < 0.001


def test_true_mesh_and_mesh_without_masks_are_unchanged() -> None:
    views = masks(sphere(0.5), ring(8))
    true = sphere(0.5)
    result = refine_silhouettes(np.asarray(true.vertices), np.asarray(true.faces, np.int32), lambda: each(views), 2, 1)
    assert np.abs(np.linalg.norm(result.vertices, axis=1) - 0.5).max() < 0.003  # a quarter of a pixel
    empty = [(camera, np.zeros_like(mask)) for camera, mask in views]
    unchanged = refine_silhouettes(np.asarray(true.vertices), np.asarray(true.faces, np.int32), lambda: each(empty), 2, 1)
    assert unchanged.contour_points == 0
    assert np.array_equal(unchanged.vertices, true.vertices)


def test_interior_contours_are_ignored() -> None:
    ball, small = sphere(0.5), trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    camera = ring(1)[0]
    small.apply_translation(0.7 * camera.centre / np.linalg.norm(camera.centre))
    both = trimesh.util.concatenate([ball, small])
    ((_, mask),) = masks(both, [camera])
    normals = vertex_normals(np.asarray(both.vertices), np.asarray(both.faces))
    contour = find_contour_points(RayCaster(both.vertices, both.faces, 1), normals, unique_edges(both.faces), camera, mask)
    assert len(contour) > 50
    assert contour.start.max() < len(ball.vertices)


def test_displacements_are_interpolated_and_robust_to_an_outlier() -> None:
    count = 101
    edges = np.stack([np.arange(count - 1), np.arange(1, count)], 1).astype(np.int64)
    at = np.arange(0, count, 2)
    offset = np.full(len(at), 0.5)
    offset[10] = SEARCH_RADIUS
    contour = ContourPoints(at, at, np.zeros(len(at)), offset, np.full(len(at), 0.01))
    moved = solve_displacements(contour, edges, count, radius=3.0)
    assert moved == pytest.approx(np.full(count, 0.005), rel=0.6)
    assert moved[60:] == pytest.approx(np.full(41, 0.005), rel=0.01)
