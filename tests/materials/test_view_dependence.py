"""Which photos see which places of a mesh, and whether those look the same in them."""

from __future__ import annotations

import numpy as np
import trimesh

from gsbake.capture.posed_photos import View
from gsbake.capture.view_dependence import looks_diffuse
from gsbake.geometry.raycast import RayCaster
from gsbake.materials.view_dependence import MeshWatch, seen_on_mesh
from tests.meshing.scenes import camera_at, cameras_around


def two_balls() -> tuple[trimesh.Trimesh, RayCaster]:
    """A ball of radius 0.5 at the origin and a small one on the x axis that hides a part of it."""
    small = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    small.apply_translation([0.9, 0, 0])
    mesh = trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=4, radius=0.5), small])
    return mesh, RayCaster(mesh.vertices, mesh.faces, 1)


def test_hidden_averted_and_masked_places_are_not_seen() -> None:
    mesh, caster = two_balls()
    camera = camera_at(np.array([3.0, 0.01, 0.02]), "front", 200)
    normals = np.array([[1.0, 0, 0], [0.7, 0.7, 0.14], [-1.0, 0, 0], [0.1, 0, 0.995], [0.7, -0.7, 0.14]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 0.5 * normals
    seen = seen_on_mesh(camera, None, points, normals, caster, 1.5)
    assert seen.tolist() == [False, True, False, False, True]  # behind the small ball, seen, averted, grazing, seen
    pixel, _ = camera.project(points)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    column = round(pixel[1, 0])
    mask[:, max(0, column - 8) : column + 8] = 255
    assert seen_on_mesh(camera, mask, points, normals, caster, 1.5).tolist() == [False, True, False, False, False]


def photographed(glossy: bool) -> tuple[bool, str]:
    """The verdict on the larger ball, lit from above; glossy: from wherever the camera stands."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    caster = RayCaster(ball.vertices, ball.faces, 1)
    points, faces = trimesh.sample.sample_surface(ball, 1500, seed=0)
    watch = MeshWatch(points, ball.face_normals[faces], caster, 1.0)
    for camera in cameras_around():
        hits = caster.first_hit(camera.centre[None], camera.rays().reshape(-1, 3))
        at = np.nan_to_num(caster.points(hits)) / 0.5
        light = camera.centre / np.linalg.norm(camera.centre) if glossy else np.array([0.0, 0, 1])
        grey = np.where(hits.hit, 110 + 70 * (at @ light), 0).reshape(camera.height, camera.width)
        rgb = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, 2)
        watch.add(View(camera, rgb, np.where(hits.hit, 255, 0).astype(np.uint8).reshape(rgb.shape[:2])))
    return looks_diffuse(*watch.changes())


def test_light_fixed_to_the_object_is_diffuse_light_that_moves_is_not() -> None:
    holds, evidence = photographed(glossy=False)
    assert holds, evidence
    holds, evidence = photographed(glossy=True)
    assert not holds, evidence
