"""Compare the libraries that decimate (`mesh.decimator`) on one dense mesh, at the same number of faces.

python -m benchmarks.decimators DENSE.ply [--faces 30000]

Prints one line per library: faces, deviation from the dense mesh on both surfaces (99.9 % quantile and maximum, in % of the diagonal),
mean angle between the nearest faces' normals, non-manifold edges before and after the repair, connected components, triangles thinner
than a fiftieth of their length, and seconds.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.geometry.ply import read_mesh
from gsbake.meshing.cleanup import Faces, Vertices, topology
from gsbake.meshing.decimation import decimate_to_error_bound, surface_deviation
from gsbake.meshing.decimator_choice import Decimator
from gsbake.meshing.decimators import decimate

DECIMATORS: tuple[Decimator, ...] = ("pymeshlab", "fast-simplification")
#: Height over longest edge below which a triangle is a sliver.
SLIVER = 0.02


def compare(vertices: Vertices, faces: Faces, target: int, decimator: Decimator) -> dict[str, float]:
    """Figures of one library; lengths in % of the diagonal."""
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    start = time.perf_counter()
    raw = decimate(vertices, faces, target, decimator)
    seconds = time.perf_counter() - start
    result = decimate_to_error_bound(vertices, faces, target, target, 0.0, decimator)
    low_poly = result.vertices, result.faces
    deviation = surface_deviation((vertices, faces), low_poly)
    return {
        "faces": len(result.faces),
        "quantile_pct": 100 * deviation.quantile / diagonal,
        "maximum_pct": 100 * deviation.maximum / diagonal,
        "normal_degrees": normal_difference((vertices, faces), low_poly),
        "non_manifold_before": topology(*raw).non_manifold_edges,
        "non_manifold": result.topology.non_manifold_edges,
        "border_edges": result.topology.border_edges,
        "components": result.topology.components,
        "slivers": int((flatness(*low_poly) < SLIVER).sum()),
        "seconds": seconds,
    }


def flatness(vertices: Vertices, faces: Faces) -> NDArray[np.float64]:
    """Smallest height over longest edge (f,) of each triangle."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2).max(1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.asarray(area / np.maximum(longest, 1e-300) ** 2, np.float64)


def normal_difference(first: tuple[Vertices, Faces], second: tuple[Vertices, Faces]) -> float:
    """Mean angle in degrees between the normals of the first mesh's faces and those of the second's face with the nearest centre."""

    def parts(vertices: Vertices, faces: Faces) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return corners.mean(1), normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]

    (centres, normals), (others, their_normals) = parts(*first), parts(*second)
    nearest = cKDTree(others).query(centres)[1]
    cosine = (normals * their_normals[nearest]).sum(1).clip(-1, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dense", type=Path)
    parser.add_argument("--faces", type=int, default=30_000)
    options = parser.parse_args()
    vertices, faces = read_mesh(options.dense)
    print(f"{options.dense}: {len(faces)} faces")
    for decimator in DECIMATORS:
        figures = compare(np.asarray(vertices, np.float64), np.asarray(faces, np.int32), options.faces, decimator)
        print(decimator, *(f"{name} {value:.4g}" for name, value in figures.items()), sep="  ")


if __name__ == "__main__":
    main()
