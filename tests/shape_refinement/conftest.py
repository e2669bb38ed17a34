"""A sphere that mirrors a known light, seen by cameras around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh

from gsbake.geometry.cameras import Camera
from gsbake.shading.octahedral import texel_directions
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Photo
from gsbake.shape_refinement.surface import Surface
from gsbake.synth.capture import look_at


@dataclass(frozen=True)
class Ball:
    """Mesh, cameras, light and photos of a sphere of radius 0.5; `metal` scales its reflections, `texture` its diffuse colour."""

    surface: Surface
    vertices: np.ndarray
    normals: np.ndarray
    cameras: tuple[Camera, ...]
    light: ReflectionMap

    @property
    def centres(self) -> np.ndarray:
        return np.stack([camera.centre for camera in self.cameras])

    def photos(self, metal: float, texture: float) -> list[Photo]:
        """Renders of the exact sphere."""
        out = []
        for camera in self.cameras:
            rays = camera.rays().reshape(-1, 3)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            along = -(rays @ camera.centre)
            square = camera.centre @ camera.centre - along**2
            hit = square < 0.25
            point = camera.centre + rays * (along - np.sqrt(np.maximum(0.25 - square, 0)))[:, None]
            normal = point / 0.5
            mirrored = rays - 2 * (rays * normal).sum(1, keepdims=True) * normal
            shade = metal * smooth_light(mirrored) + texture * pattern(point)
            rgb = np.where(hit[:, None], shade, 0).reshape(camera.height, camera.width, 3)
            out.append(Photo(camera, np.ascontiguousarray(rgb, np.float32), hit.reshape(rgb.shape[:2]).astype(np.float32)))
        return out


def smooth_light(directions: np.ndarray) -> np.ndarray:
    """Light from three soft lamps of different colours."""
    lamps = np.array([[0.8, 0.1, 0.6], [-0.5, 0.7, 0.5], [0.1, -0.9, -0.4]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    colours = np.array([[1.0, 0.8, 0.5], [0.4, 0.7, 1.0], [0.6, 0.9, 0.6]])
    return 0.1 + np.exp(6 * (directions @ lamps.T - 1)) @ colours


def pattern(points: np.ndarray) -> np.ndarray:
    """A smooth texture of the position."""
    waves = np.stack([np.sin(9 * points @ axis) for axis in np.array([[1, 0.3, 0.2], [0.1, 1, 0.4], [0.3, 0.2, 1]])], 1)
    return 0.5 + 0.25 * waves


@pytest.fixture(scope="session")
def ball() -> Ball:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    surface = Surface(len(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int32))
    vertices = np.array(mesh.vertices, np.float64)
    turns, rise = np.arange(12) * 2.4, np.linspace(-0.9, 0.9, 12)  # a spiral over the sphere
    directions = np.stack([np.cos(turns) * np.sqrt(1 - rise**2), np.sin(turns) * np.sqrt(1 - rise**2), rise], 1)
    cameras = []
    for index, direction in enumerate(directions):
        centre = 2.5 * direction / np.linalg.norm(direction)
        cameras.append(look_at(f"{index}", centre, np.zeros(3), 0.1 * index, 180.0, (64.0, 62.0), 128))
    light = ReflectionMap(24, smooth_light(texel_directions(24)).astype(np.float32))
    return Ball(surface, vertices, surface.normals(vertices), tuple(cameras), light)
