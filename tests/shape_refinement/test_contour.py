"""Contour points: a smaller sphere's distance from the masks, and its recovery from them alone."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.shape_refinement.contour import find_contour_points
from gsbake.shape_refinement.refine import pixel_size, refine_shape
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.surface import Surface
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


def refined(mesh: trimesh.Trimesh, views: list[Masked]) -> np.ndarray:
    """The vertices after refinement by masks alone: the photos are grey."""
    photos = [Photo(camera, np.full((*mask.shape, 3), 0.5, np.float32), mask.astype(np.float32) / 255) for camera, mask in views]
    vertices, faces = np.array(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int32)
    pixel = pixel_size(vertices, [camera for camera, _ in views])
    return refine_shape(vertices, faces, lambda blur: photos, lambda: views, pixel).vertices


def sphere(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def test_offset_of_a_smaller_sphere_equals_the_analytic_one() -> None:
    camera, mask = masks(sphere(0.5), ring(1), supersampling=8)[0]
    small = sphere(0.48)
    edges = Surface(len(small.vertices), np.asarray(small.faces, np.int32)).edges
    contour = find_contour_points(RayCaster(small.vertices, small.faces, 1), np.asarray(small.vertex_normals), edges, camera, mask)
    # A sphere of radius r at distance d shows a disc of tan(asin(r / d)); off the axis it is a slightly longer ellipse.
    expected = camera.fx * (np.tan(np.arcsin(0.5 / 4)) - np.tan(np.arcsin(0.48 / 4)))
    assert len(contour) > 100
    assert abs(np.median(contour.offset * contour.pixel) - 0.02) < 0.0015
    assert abs(np.median(contour.offset) - expected) < 0.25


def test_sphere_is_recovered() -> None:
    radius = np.linalg.norm(refined(sphere(0.48), masks(sphere(0.5), ring(12))), axis=1)
    assert abs(radius.mean() - 0.5) < 0.002
    assert radius.std() < 0.002


def test_true_mesh_and_mesh_without_masks_stay() -> None:
    views = masks(sphere(0.5), ring(8))
    assert np.abs(np.linalg.norm(refined(sphere(0.5), views), axis=1) - 0.5).max() < 0.003  # a quarter of a pixel
    empty = [(camera, np.zeros_like(mask)) for camera, mask in views]
    assert np.abs(refined(sphere(0.5), empty) - sphere(0.5).vertices).max() < 1e-6


def test_interior_contours_are_ignored() -> None:
    ball, small = sphere(0.5), trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    camera = ring(1)[0]
    small.apply_translation(0.7 * camera.centre / np.linalg.norm(camera.centre))
    both = trimesh.util.concatenate([ball, small])
    ((_, mask),) = masks(both, [camera])
    surface = Surface(len(both.vertices), np.asarray(both.faces, np.int32))
    normals = surface.normals(np.asarray(both.vertices))
    contour = find_contour_points(RayCaster(both.vertices, both.faces, 1), normals, surface.edges, camera, mask)
    assert len(contour) > 50
    assert contour.start.max() < len(ball.vertices)
