"""Visibility of points on a mesh, and view dependence of their brightness."""

from __future__ import annotations

import numpy as np
import trimesh

from gsbake.capture.posed_photos import View
from gsbake.capture.view_dependence import is_diffuse
from gsbake.geometry.raycast import RayCaster
from gsbake.materials.photo import MeshBrightness, visible_on_mesh
from tests.meshing.scenes import camera_at, cameras_around


def two_balls() -> tuple[trimesh.Trimesh, RayCaster]:
    """A ball of radius 0.5 at the origin and a small one on the x axis that hides a part of it."""
    small = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    small.apply_translation([0.9, 0, 0])
    mesh = trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=4, radius=0.5), small])
    return mesh, RayCaster(mesh.vertices, mesh.faces, 1)


def test_occluded_averted_and_masked_points_are_not_visible() -> None:
    mesh, caster = two_balls()
    camera = camera_at(np.array([3.0, 0.01, 0.02]), "front", 200)
    normals = np.array([[1.0, 0, 0], [0.7, 0.7, 0.14], [-1.0, 0, 0], [0.1, 0, 0.995], [0.7, -0.7, 0.14]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 0.5 * normals
    visible = visible_on_mesh(camera, None, points, normals, caster, 1.5)
    assert visible.tolist() == [False, True, False, False, True]  # occluded, visible, averted, grazing, visible
    pixel, _ = camera.project(points)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    column = round(pixel[1, 0])
    mask[:, max(0, column - 8) : column + 8] = 255
    assert visible_on_mesh(camera, mask, points, normals, caster, 1.5).tolist() == [False, True, False, False, False]


def measured(glossy: bool) -> tuple[bool, str]:
    """Whether the larger sphere is diffuse, lit from above; `glossy`: lit from the camera."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    caster = RayCaster(ball.vertices, ball.faces, 1)
    points, faces = trimesh.sample.sample_surface(ball, 1500, seed=0)
    brightness = MeshBrightness(points, ball.face_normals[faces], caster, 1.0)
    for camera in cameras_around():
        hits = caster.first_hit(camera.centre[None], camera.rays().reshape(-1, 3))
        at = np.nan_to_num(caster.points(hits)) / 0.5
        light = camera.centre / np.linalg.norm(camera.centre) if glossy else np.array([0.0, 0, 1])
        grey = np.where(hits.hit, 110 + 70 * (at @ light), 0).reshape(camera.height, camera.width)
        rgb = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, 2)
        brightness.add(View(camera, rgb, np.where(hits.hit, 255, 0).astype(np.uint8).reshape(rgb.shape[:2])))
    return is_diffuse(*brightness.statistics())


def test_fixed_light_is_diffuse_and_moving_light_is_not() -> None:
    holds, evidence = measured(glossy=False)
    assert holds, evidence
    holds, evidence = measured(glossy=True)
    assert not holds, evidence
