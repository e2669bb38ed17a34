"""Analytic object of the built-in capture: a signed distance field with materials.

The object is a jar with a bowl-shaped top, a glossy glazed band, a round emissive patch, a metal foot and a thin metal handle. World
frame: Z-up, the object stands on z = 0 at `ORIGIN`. Primitives are exact distances (rounded cylinder, torus, sphere); unions by min and
the carved bowl by max keep the field 1-Lipschitz, as sphere tracing requires (Hart, *Sphere tracing*, The Visual Computer 1996). Four
materials: a diffuse textured dielectric, a glossy dielectric (the glazed band), a rough gold-like metal, and the emissive patch. The
texture is hashed value noise, aperiodic, so that structure from motion finds unique features. The emissive patch is flush with the convex
side of the jar, so no other point of the object receives its light.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Intersection of the object's axis with the ground (world), off the world origin to reveal confused frames.
ORIGIN = (0.2, -0.1, 0.0)
#: Centre (world) and radius of a bounding sphere of the object.
CENTRE = (0.33, -0.1, 0.46)
RADIUS = 0.75

BODY_Z, BODY_RADIUS, BODY_HALF, BODY_ROUND = 0.52, 0.40, 0.40, 0.08
BOWL_Z, BOWL_RADIUS = 1.10, 0.36
FOOT_Z, FOOT_RADIUS, FOOT_HALF, FOOT_ROUND = 0.08, 0.30, 0.08, 0.03
HANDLE_X, HANDLE_Z, HANDLE_MAJOR, HANDLE_MINOR = 0.40, 0.52, 0.22, 0.04
#: The glazed band around the jar: range of heights, linear albedo and roughness.
GLAZE_Z, GLAZE_ALBEDO, GLAZE_ROUGHNESS = (0.16, 0.34), (0.05, 0.12, 0.34), 0.22
#: The emissive patch, in direction (-1, 0) from the axis: height, radius and radiance (linear; above 1 would clip in the photos).
EMITTER_Z, EMITTER_RADIUS, EMITTER_RADIANCE = 0.66, 0.09, (0.95, 0.80, 0.45)

#: The printed marker on the ground: number in OpenCV's dictionary of 4 × 4 cells, edge and centre (world), its white margin in cells.
MARKER_NUMBER, MARKER_SIZE, MARKER_CENTRE, MARKER_MARGIN = 7, 0.2, (0.33, 0.48), 1.0
#: The cells of no marker.
NO_MARKER = np.zeros((0, 0), np.uint8)

_compiled: Any = njit(cache=True, nogil=True, error_model="numpy")
_inlined: Any = njit(cache=True, nogil=True, error_model="numpy", forceinline=True)


@_inlined
def _rounded_cylinder(radial: float, z: float, radius: float, half: float, rounding: float) -> float:
    """Signed distance to a cylinder around z of the given outer size, with rounded edges."""
    a = radial - (radius - rounding)
    b = abs(z) - (half - rounding)
    return min(max(a, b), 0.0) + math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2) - rounding


@_compiled
def ceramic_distance(x: float, y: float, z: float) -> float:
    """Signed distance (negative inside) of a world point to the jar with its bowl carved out; 1-Lipschitz."""
    dx, dy = x - ORIGIN[0], y - ORIGIN[1]
    radial = math.sqrt(dx * dx + dy * dy)
    body = _rounded_cylinder(radial, z - BODY_Z, BODY_RADIUS, BODY_HALF, BODY_ROUND)
    bowl = math.sqrt(dx * dx + dy * dy + (z - BOWL_Z) ** 2) - BOWL_RADIUS
    return max(body, -bowl)


@_compiled
def metal_distance(x: float, y: float, z: float) -> float:
    """Signed distance of a world point to the metal foot and handle; 1-Lipschitz."""
    dx, dy = x - ORIGIN[0], y - ORIGIN[1]
    foot = _rounded_cylinder(math.sqrt(dx * dx + dy * dy), z - FOOT_Z, FOOT_RADIUS, FOOT_HALF, FOOT_ROUND)
    ring = math.sqrt((dx - HANDLE_X) ** 2 + (z - HANDLE_Z) ** 2) - HANDLE_MAJOR
    return min(foot, math.sqrt(ring * ring + dy * dy) - HANDLE_MINOR)


@_compiled
def distance(x: float, y: float, z: float) -> float:
    """Signed distance of a world point to the whole object; 1-Lipschitz, exact outside except within the bowl's opening."""
    return min(ceramic_distance(x, y, z), metal_distance(x, y, z))


@_compiled
def normal(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit gradient of the field by finite differences along a tetrahedron (four evaluations)."""
    h = 1e-5
    a = distance(x + h, y - h, z - h)
    b = distance(x - h, y - h, z + h)
    c = distance(x - h, y + h, z - h)
    d = distance(x + h, y + h, z + h)
    nx, ny, nz = a - b - c + d, -a - b + c + d, -a + b - c + d
    length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-300
    return nx / length, ny / length, nz / length


@_inlined
def _lattice(i: int, j: int, k: int) -> float:
    """Hash of a lattice point to 0..1 (integer avalanche in 32 bits)."""
    h = (i * 374761393 + j * 668265263 + k * 2147483647 + 1013904223) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return float((h ^ (h >> 15)) & 0xFFFFFF) / 16777215.0


@_compiled
def noise(x: float, y: float, z: float) -> float:
    """Value noise in 0..1 with unit cells and smooth (C1) interpolation."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
                total += weight * _lattice(int(i) + a, int(j) + b, int(k) + c)
    return total


@_inlined
def _step(edge0: float, edge1: float, value: float) -> float:
    """Smooth step from 0 at edge0 to 1 at edge1."""
    t = min(max((value - edge0) / (edge1 - edge0), 0.0), 1.0)
    return t * t * (3 - 2 * t)


@_inlined
def _in_emitter(x: float, y: float, z: float) -> bool:
    """Whether a world point on the surface belongs to the emissive patch."""
    dy, dz = y - ORIGIN[1], z - EMITTER_Z
    return x < ORIGIN[0] - 0.5 * BODY_RADIUS and dy * dy + dz * dz < EMITTER_RADIUS * EMITTER_RADIUS


@_compiled
def emission(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Emitted radiance (3), linear, of the surface point nearest to a world point."""
    if _in_emitter(x, y, z):
        return EMITTER_RADIANCE
    return 0.0, 0.0, 0.0


@_compiled
def material(x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Linear albedo (3), perceptual roughness and metallic of the surface point nearest to a world point."""
    coarse = noise(7 * x, 7 * y, 7 * z)
    fine = noise(23 * x + 5, 23 * y + 7, 23 * z)
    if metal_distance(x, y, z) < ceramic_distance(x, y, z):
        shade = 0.85 + 0.3 * (coarse - 0.5)
        return 0.82 * shade, 0.62 * shade, 0.33 * shade, 0.42 + 0.12 * (fine - 0.5), 1.0
    if GLAZE_Z[0] < z < GLAZE_Z[1]:
        return GLAZE_ALBEDO[0], GLAZE_ALBEDO[1], GLAZE_ALBEDO[2], GLAZE_ROUGHNESS, 0.0
    if _in_emitter(x, y, z):
        return 0.03, 0.03, 0.03, 0.5, 0.0
    # Cream base, patches of teal and rust at two scales, and dark speckles: strong, aperiodic edges.
    teal = _step(0.50, 0.58, coarse)
    rust = _step(0.58, 0.66, noise(11 * x + 31, 11 * y, 11 * z + 17))
    speckle = 0.55 * _step(0.62, 0.72, fine)
    r = (1 - teal) * 0.68 + teal * 0.10
    g = (1 - teal) * 0.58 + teal * 0.36
    b = (1 - teal) * 0.40 + teal * 0.38
    r, g, b = (1 - rust) * r + rust * 0.52, (1 - rust) * g + rust * 0.15, (1 - rust) * b + rust * 0.06
    scale = 1 - speckle
    return r * scale, g * scale, b * scale, 0.75, 0.0


def marker_cells() -> NDArray[np.uint8]:
    """The printed marker's cells (6, 6), 1 = white, its black border included; the first row is at high y, columns go along x."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, MARKER_NUMBER, 6) > 0, np.uint8)


@_compiled
def ground(x: float, y: float, marker: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Linear albedo of the diffuse ground z = 0 (used only for photos with a background), with a printed `marker` (k, k); k = 0: none."""
    cells = len(marker)
    if cells:
        column = (x - MARKER_CENTRE[0]) / MARKER_SIZE * cells + 0.5 * cells
        row = (MARKER_CENTRE[1] - y) / MARKER_SIZE * cells + 0.5 * cells
        if 0 <= column < cells and 0 <= row < cells:
            paper = 0.03 + 0.77 * marker[int(row), int(column)]
            return paper, paper, paper
        if min(column, row) >= -MARKER_MARGIN and max(column, row) < cells + MARKER_MARGIN:
            return 0.8, 0.8, 0.8
    value = 0.55 * noise(5 * x, 5 * y, 40.5) + 0.45 * noise(13 * x, 13 * y, 80.5)
    dark = _step(0.42, 0.56, value)
    tint = noise(2 * x, 2 * y, 9.5)
    return 0.10 + 0.50 * dark, 0.10 + (0.38 + 0.1 * tint) * dark, 0.12 + 0.34 * dark * tint


@_compiled
def trace(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, start: float, epsilon: float
) -> float:
    """Distance along a unit ray (world) to the object by sphere tracing from `start`, or -1; accurate to `epsilon`."""
    cx, cy, cz = CENTRE[0] - ox, CENTRE[1] - oy, CENTRE[2] - oz
    along = cx * dx + cy * dy + cz * dz
    inside = RADIUS * RADIUS - (cx * cx + cy * cy + cz * cz - along * along)
    if inside <= 0:
        return -1.0
    half = math.sqrt(inside)
    end = along + half
    t = max(start, along - half)
    for _ in range(160):
        if t >= end:
            return -1.0
        d = distance(ox + t * dx, oy + t * dy, oz + t * dz)
        if d < epsilon:
            return t
        t += d
    return -1.0  # a grazing ray that exceeds the steps counts as a miss


@_compiled
def distances(points: Array) -> Array:
    """Signed distances (n,) of world points (n, 3)."""
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = distance(points[i, 0], points[i, 1], points[i, 2])
    return out


@_compiled
def normals(points: Array) -> Array:
    """Unit field gradients (n, 3) at world points (n, 3)."""
    out = np.empty((len(points), 3))
    for i in range(len(points)):
        out[i, 0], out[i, 1], out[i, 2] = normal(points[i, 0], points[i, 1], points[i, 2])
    return out


@_compiled
def materials(points: Array) -> Array:
    """Linear albedo, roughness, metallic (n, 5) at world points (n, 3) on the surface."""
    out = np.empty((len(points), 5))
    for i in range(len(points)):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = material(points[i, 0], points[i, 1], points[i, 2])
    return out


@_compiled
def emissions(points: Array) -> Array:
    """Emitted radiance (n, 3) at world points (n, 3) on the surface."""
    out = np.empty((len(points), 3))
    for i in range(len(points)):
        out[i, 0], out[i, 1], out[i, 2] = emission(points[i, 0], points[i, 1], points[i, 2])
    return out


@_compiled
def grid_distances(low: Array, cell: float, nx: int, ny: int, nz: int) -> NDArray[np.float32]:
    """Signed distances on a grid (nx, ny, nz) of spacing `cell` whose first point is `low` (3,)."""
    out = np.empty((nx, ny, nz), np.float32)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                out[i, j, k] = distance(low[0] + i * cell, low[1] + j * cell, low[2] + k * cell)
    return out
