"""Building blocks of the procedural test models: materials as functions of position, and surfaces made of rings or of flat panels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]

IRON, COPPER, BRASS, STEEL = (0.30, 0.28, 0.27), (0.955, 0.638, 0.538), (0.91, 0.78, 0.42), (0.62, 0.60, 0.57)
RUST, PATINA = (0.20, 0.075, 0.03), (0.16, 0.36, 0.29)


@dataclass(frozen=True)
class Material:
    """Linear base colour (n, 3), roughness, metallic (n,) and emission (n, 3)."""

    base: Array
    roughness: Array
    metallic: Array
    emission: Array

    @classmethod
    def uniform(cls, count: int, base: tuple[float, float, float], roughness: float, metallic: float = 0.0) -> Material:
        """The same material at `count` points."""
        return cls(np.tile(base, (count, 1)), np.full(count, roughness), np.full(count, metallic), np.zeros((count, 3)))

    @classmethod
    def joined(cls, parts: Sequence[Material]) -> Material:
        """The materials of several sets of points, one after the other."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def blend(self, other: Material, share: Array) -> Material:
        """This material with a `share` (n,) of the other one."""
        s, t = share, share[:, None]
        return Material(
            self.base * (1 - t) + other.base * t, self.roughness * (1 - s) + other.roughness * s,
            self.metallic * (1 - s) + other.metallic * s, self.emission * (1 - t) + other.emission * t,
        )  # fmt: skip

    def shaded(self, factor: Array) -> Material:
        """The material with its base colour times `factor` (n,)."""
        return Material(np.clip(self.base * factor[:, None], 0, 0.98), self.roughness, self.metallic, self.emission)


def noise(points: Array, frequency: float, seed: int, waves: int = 24) -> Array:
    """Smooth noise (n,) of unit variance at `points` (n, 3)."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wave = direction * frequency * rng.uniform(0.5, 1.5, (waves, 1))
    return np.asarray(np.sin(points @ wave.T + rng.uniform(0, 2 * np.pi, waves)).sum(1) * np.sqrt(2 / waves))


def step(value: Array, edge: float, width: float) -> Array:
    """Smooth step from 0 to 1 across `edge`."""
    return np.asarray(np.clip((value - edge) / width + 0.5, 0, 1))


def revolved(profile: list[tuple[float, float]], sections: int = 96) -> trimesh.Trimesh:
    """A surface of revolution around z of a `profile` of (radius, height), smoothed by Catmull-Rom interpolation."""
    points = np.asarray(profile, np.float64)
    padded = np.concatenate([points[:1], points, points[-1:]])
    t = np.linspace(0, 1, 6, endpoint=False)[:, None]
    parts = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True)
    ]
    smooth = np.concatenate([*parts, points[-1:]])
    smooth[:, 0] = np.maximum(smooth[:, 0], 0)
    return trimesh.creation.revolve(smooth, sections=sections)


def ring_surface(rings: Array, normals: Array | None = None) -> trimesh.Trimesh:
    """A surface through closed `rings` (m, n, 3), outside from the bottom up, with `normals` (m, n, 3) or those that its faces give.

    Rings may be points (poles), and two of one place with other normals are a sharp edge.
    """
    count, around = rings.shape[:2]
    k, i = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    j = (i + 1) % around
    a, b, c, d = (np.ravel(row * around + column) for row, column in ((k, i), (k, j), (k + 1, j), (k + 1, i)))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    vertices = rings.reshape(-1, 3)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    smooth = None if normals is None else normals.reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces[area > 1e-9], vertex_normals=smooth, process=False)


def turned(profile: Sequence[tuple[float, float, float]], sections: int = 128, segments: int = 8) -> trimesh.Trimesh:
    """A surface of revolution around z of straight legs between corners (radius, height, fillet), counter-clockwise: outside upwards.

    A fillet is the radius of the arc that replaces the corner, in `segments` parts; 0 leaves it sharp. Normals are exact.
    """
    corners = np.asarray(profile, np.float64)
    along = np.diff(corners[:, :2], axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    points, normals = [corners[:1, :2]], [outward[:1]]
    for corner, before, after, first, last in zip(corners[1:-1], along[:-1], along[1:], outward[:-1], outward[1:], strict=True):
        angle = np.arccos(np.clip(before @ after, -1, 1))
        side = np.sign(before[0] * after[1] - before[1] * after[0])
        share = np.linspace(0, 1, segments + 1)[:, None]
        turning = (np.sin((1 - share) * angle) * first + np.sin(share * angle) * last) / np.sin(angle)
        start = corner[:2] - corner[2] * np.tan(angle / 2) * before
        points.append(start + side * corner[2] * (turning - first))
        normals.append(turning)
    points.append(corners[-1:, :2])
    normals.append(outward[-1:])
    turn = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], 1)

    def revolve(flat: Array) -> Array:
        return np.concatenate([flat[:, None, :1] * around, np.broadcast_to(flat[:, None, 1:], (len(flat), sections, 1))], 2)

    return ring_surface(revolve(np.concatenate(points)), revolve(np.concatenate(normals)))


def bar(path: Array, aside: Array, radii: tuple[float, float], sections: int = 32) -> trimesh.Trimesh:
    """A closed bar along a flat `path` (k, 3): an ellipse of `radii` in the path's plane and along its unit normal `aside` (3,)."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    within = np.cross(aside, tangent)
    turn = np.linspace(0, 2 * np.pi, sections, endpoint=False)[None, :, None]
    offset = radii[0] * np.cos(turn) * within[:, None] + radii[1] * np.sin(turn) * aside
    normal = radii[1] * np.cos(turn) * within[:, None] + radii[0] * np.sin(turn) * aside
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    ends = [
        (path[k] + 0 * offset[k], path[k] + offset[k], np.broadcast_to(s * tangent[k], offset[k].shape)) for k, s in ((0, -1.0), (-1, 1.0))
    ]
    (tip, edge, back), (last_tip, last_edge, front) = ends
    rings = np.concatenate([[tip, edge], path[:, None] + offset, [last_edge, last_tip]])
    return ring_surface(rings, np.concatenate([[back, back], normal, [front, front]]))


def panels(quads: Sequence[Sequence[Sequence[float]]]) -> trimesh.Trimesh:
    """Flat quadrilaterals, each four corners (3,) counter-clockwise as seen from outside, that share no vertex: all edges are sharp."""
    corners = np.asarray(quads, np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    faces = (4 * np.arange(len(corners))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    return trimesh.Trimesh(corners.reshape(-1, 3), faces, vertex_normals=np.repeat(normal, 4, axis=0), process=False)


def joined(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The parts as one mesh with their own normals."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    vertices, normals = (np.concatenate([np.asarray(getattr(part, name)) for part in parts]) for name in ("vertices", "vertex_normals"))
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
