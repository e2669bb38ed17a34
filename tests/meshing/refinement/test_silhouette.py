"""Silhouettes brought to the masks: a sphere and a box of known size come back from ones that are too small."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.meshing.refinement.normals import edges_of, vertex_normals
from gsbake.meshing.refinement.silhouette import REACH, Rims, find_rims, polish, solve

Masked = tuple[Camera, NDArray[np.uint8]]


def ring(count: int, size: int = 160) -> list[Camera]:
    """Cameras around the origin at distance 4, at three heights, slightly off centre."""
    cameras = []
    for k in range(count):
        turn, high = 2.4 * k, (-0.5, 0.1, 0.8)[k % 3]
        centre = 4 * np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        forward = -centre / 4
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(f"{k}", size, size - 20, 2.0 * size, 2.0 * size, size / 2 + 3.3, size / 2 - 9.1, R, -R @ centre))
    return cameras


def masks(mesh: trimesh.Trimesh, cameras: list[Camera], fine: int = 4) -> list[Masked]:
    """Coverage of the mesh in each camera with fine² rays a pixel."""
    caster = RayCaster(mesh.vertices, mesh.faces, 1)
    out = []
    for camera in cameras:
        hit = caster.depth(camera.scaled(camera.width * fine, camera.height * fine)) > 0
        cover = hit.reshape(camera.height, fine, camera.width, fine).mean((1, 3))
        out.append((camera, np.round(255 * cover).astype(np.uint8)))
    return out


def each(views: list[Masked]) -> Iterator[Masked]:
    yield from views


def sphere(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def test_offset_of_a_small_sphere_is_what_geometry_says() -> None:
    camera, mask = masks(sphere(0.5), ring(1), fine=8)[0]
    small = sphere(0.48)
    edges = edges_of(small.faces)
    rims = find_rims(RayCaster(small.vertices, small.faces, 1), np.asarray(small.vertex_normals), edges, camera, mask)
    # A sphere of radius r at distance d shows a disc of tan(asin(r / d)); off the axis it is a slightly longer ellipse.
    expected = camera.fx * (np.tan(np.arcsin(0.5 / 4)) - np.tan(np.arcsin(0.48 / 4)))
    assert len(rims) > 100
    assert abs(np.median(rims.offset * rims.pixel) - 0.02) < 0.0015
    assert abs(np.median(rims.offset) - expected) < 0.25


def test_polish_restores_a_sphere() -> None:
    views = masks(sphere(0.5), ring(12))
    small = sphere(0.48)
    done = polish(np.asarray(small.vertices), np.asarray(small.faces, np.int32), lambda: each(views), 3, 1)
    radius = np.linalg.norm(done.vertices, axis=1)
    assert done.before > 1.5
    assert abs(done.after) < 0.1
    assert abs(radius.mean() - 0.5) < 0.001
    assert radius.std() < 0.001


def test_polish_leaves_a_right_mesh_alone_and_says_when_there_is_nothing_to_go_by() -> None:
    views = masks(sphere(0.5), ring(8))
    right = sphere(0.5)
    done = polish(np.asarray(right.vertices), np.asarray(right.faces, np.int32), lambda: each(views), 2, 1)
    assert np.abs(np.linalg.norm(done.vertices, axis=1) - 0.5).max() < 0.003  # a quarter of a pixel
    empty = [(camera, np.zeros_like(mask)) for camera, mask in views]
    same = polish(np.asarray(right.vertices), np.asarray(right.faces, np.int32), lambda: each(empty), 2, 1)
    assert same.rims == 0
    assert np.array_equal(same.vertices, right.vertices)


def test_rims_in_front_of_the_object_are_not_compared_with_the_mask() -> None:
    ball, small = sphere(0.5), trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    camera = ring(1)[0]
    small.apply_translation(0.7 * camera.centre / np.linalg.norm(camera.centre))
    both = trimesh.util.concatenate([ball, small])
    (_, mask), = masks(both, [camera])
    normals = vertex_normals(np.asarray(both.vertices), np.asarray(both.faces))
    rims = find_rims(RayCaster(both.vertices, both.faces, 1), normals, edges_of(both.faces), camera, mask)
    assert len(rims) > 50
    assert rims.start.max() < len(ball.vertices)


def test_solve_carries_a_displacement_and_resists_an_outlier() -> None:
    count = 101
    edges = np.stack([np.arange(count - 1), np.arange(1, count)], 1).astype(np.int64)
    at = np.arange(0, count, 2)
    offset = np.full(len(at), 0.5)
    offset[10] = REACH
    rims = Rims(at, at, np.zeros(len(at)), offset, np.full(len(at), 0.01))
    moved = solve(rims, edges, count, reach=3.0)
    assert moved == pytest.approx(np.full(count, 0.005), rel=0.6)
    assert moved[60:] == pytest.approx(np.full(41, 0.005), rel=0.01)
