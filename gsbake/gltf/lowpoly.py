"""A low-poly mesh of another program (GLB, glTF, OBJ, PLY), with its UVs, in the unit frame of the run that it belongs to.

Programs turn +Z up into +Y up or back on export, and people start from `mesh.ply` (unit frame) or from `asset.glb` (asset frame). Of these
frames the one is taken in which the mesh lies on the dense mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Similarity
from gsbake.geometry.mesh_process import ForeignMesh, read_foreign_mesh
from gsbake.geometry.ply import read_mesh
from gsbake.geometry.surface_distance import surface_distances
from gsbake.gltf.frame import Y_UP
from gsbake.gltf.scene import open_scene
from gsbake.texturing.atlas import islands
from gsbake.texturing.given_uvs import GivenUVs, given_uvs

#: Suffixes of the formats.
GLTF_SUFFIXES = (".glb", ".gltf")
SUFFIXES = (*GLTF_SUFFIXES, ".obj", ".ply")
#: Points whose distances to the dense mesh are measured.
POINTS = 3000
#: Largest median distance to the dense mesh, as a share of its diagonal.
MAX_DISTANCE = 0.02
#: Largest diagonal of its box, as a multiple of the dense mesh's: stray vertices beyond leave the texture no texels for the object.
MAX_REACH = 10.0
#: A frame is preferred to others up to this many times as far, and up to this share of the diagonal.
TIE_FACTOR, TIE_DISTANCE = 2.0, 1e-3
#: Faces of the dense mesh that are looked at, those beside each face of the low-poly mesh, and their distance as a share of the diagonal;
#: share of an open piece's area beside which none may look as it does for it to be inside out.
DENSE_FACES, NEIGHBOURS, NEIGHBOUR_DISTANCE, MIN_AGAINST = 20_000, 64, 0.03, 0.9


@dataclass(frozen=True)
class LowPoly:
    """A mesh in the unit frame; `uv` are those of its corners, None without any; `notes` say what was read."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64] | None
    notes: tuple[str, ...]

    def split(self) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
        """Vertices, faces and UVs of vertices (origin bottom left), with vertices split at seams."""
        if self.uv is None:
            return self.vertices, self.faces, None
        rows = np.concatenate([self.faces.reshape(-1, 1), self.uv.reshape(-1, 2).astype(np.float32)], 1)
        unique, inverse = np.unique(rows, axis=0, return_inverse=True)
        return self.vertices[unique[:, 0].astype(np.int64)], inverse.reshape(-1, 3), unique[:, 1:] * (1, -1) + (0, 1)


def read_lowpoly(path: Path, dense: Path, asset: Similarity | None) -> LowPoly:
    """The mesh in `path`, placed on the dense mesh in the PLY `dense` (unit frame).

    `asset` is the map from the unit frame to that of the asset, None where there is no asset yet. Raises BadInputError where the mesh lies
    in none of the frames, or has UVs that the asset cannot have.
    """
    mesh = _read(path)
    corner = mesh.vertices[mesh.faces]
    if not np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).any():
        raise BadInputError(f"'{path}' has no triangle with an area.")
    try:
        given = given_uvs(mesh.vertices, mesh.faces, mesh.uv, mesh.materials)
    except ValueError as error:
        raise BadInputError(f"'{path}' {error}.") from error
    try:
        surface = read_mesh(dense)
    except ValueError as error:
        raise BadInputError(f"{error}; run the mesh stage again.") from error
    found = given or GivenUVs(mesh.vertices, mesh.faces, np.zeros((0, 3, 2)))
    frame, to_unit = _frame(found, path, surface, asset)
    placed = to_unit.apply(found.vertices)
    reach = float(np.linalg.norm(np.ptp(placed[found.faces].reshape(-1, 3), axis=0)) / np.linalg.norm(np.ptp(surface[0], axis=0)))
    if reach > MAX_REACH:
        raise BadInputError(f"'{path}' has vertices far from the object: it is {reach:.3g} times as large; remove them.")
    triangles = f"{len(found.faces)} triangles in {frame}"
    kept = "their UVs are kept" if given is not None else "they have no UVs and are unwrapped"
    faces, uv, inside_out = found.faces.copy(), found.uv.copy(), _inside_out(placed, found.faces, surface)
    faces[inside_out] = faces[inside_out, ::-1]
    if given is not None:
        uv[inside_out] = uv[inside_out, ::-1]
    turned = (f"{int(inside_out.sum())} of them were inside out and are turned",) if inside_out.any() else ()
    notes = triangles, kept, *turned, *found.notes, *found.faults
    return LowPoly(placed, faces, None if given is None else uv, notes)


def _read(path: Path) -> ForeignMesh:
    """Any of the formats; parts of glTF files at the places of their nodes."""
    if path.suffix.lower() not in GLTF_SUFFIXES:
        return read_foreign_mesh(path)
    scene = open_scene(path)
    sets = [part.uv[min(part.uv)] if part.uv else np.full((len(part.position), 2), np.nan, np.float32) for part in scene.parts]
    uv = np.concatenate(sets).astype(np.float64) * (1, -1) + (0, 1)
    materials = len({part.material for part in scene.parts})
    return ForeignMesh(scene.vertices, scene.faces.astype(np.int64), None if np.isnan(uv).all() else uv, materials)


def _frame(
    mesh: GivenUVs, path: Path, dense: tuple[NDArray[np.float64], NDArray[np.int64]], asset: Similarity | None
) -> tuple[str, Similarity]:
    """Name of the frame of the mesh, and the map from it to the unit frame. Raises BadInputError."""
    frames = _frames(path, asset)
    points = np.concatenate([mesh.vertices, mesh.vertices[mesh.faces].mean(1)])
    points = points[:: max(1, len(points) // POINTS)]
    diagonal = float(np.linalg.norm(np.ptp(dense[0], axis=0)))
    away = {name: float(np.median(surface_distances(frame.apply(points), *dense))) for name, frame in frames.items()}
    nearest = min(away.values())
    if not nearest <= MAX_DISTANCE * diagonal:
        raise BadInputError(
            f"'{path}' does not lie on the dense mesh: half of it is more than {nearest / diagonal:.0%} of the object's size away, in the "
            "frame of mesh.ply as in that of asset.glb, with +Y or +Z up; export it where the mesh lay that you started from."
        )
    name = next(name for name, far in away.items() if far <= max(TIE_FACTOR * nearest, TIE_DISTANCE * diagonal))
    return name, frames[name]


def _inside_out(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], dense: tuple[NDArray[np.float64], NDArray[np.int64]]
) -> NDArray[np.bool_]:
    """Which of the `faces` (f, 3) belong to pieces that are inside out: closed ones of negative volume, but for hollows in others; open
    ones if the dense surface beside most of their area looks the other way only. Beside thin walls it looks both ways."""
    joined = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    middle, normal = _middles(vertices, faces)
    piece = islands(int(joined.max()) + 1, joined)
    near, outwards = (values[:: max(1, len(dense[1]) // DENSE_FACES)] for values in _middles(*dense))
    far, beside = (found.reshape(len(faces), -1) for found in cKDTree(near).query(middle, min(NEIGHBOURS, len(near))))
    close = far <= np.maximum(far[:, :1], NEIGHBOUR_DISTANCE * np.linalg.norm(np.ptp(near, axis=0)))
    agrees = (close & (np.einsum("nk,nmk->nm", normal, outwards[beside]) > 0)).any(1)
    area = np.linalg.norm(normal, axis=1)
    against = np.bincount(piece, area * ~agrees) > MIN_AGAINST * np.bincount(piece, area)
    volume = np.bincount(piece, np.einsum("nk,nk->n", middle - middle.mean(0), normal))
    closed = _closed(joined, piece)
    largest = np.abs(volume) == np.abs(volume[closed]).max(initial=0)
    return np.asarray(np.where(closed, (volume < 0) & (against | largest), against)[piece])


def _closed(faces: NDArray[np.int64], piece: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which pieces (k,) of the `faces` (f, 3) have each edge twice, once in each direction."""
    start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
    count = int(faces.max()) + 1
    edge, back = np.sort(start * count + end), end * count + start
    alone = (np.searchsorted(edge, back, "right") - np.searchsorted(edge, back, "left")) != 1
    return np.bincount(np.repeat(piece, 3), alone) == 0


def _middles(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The middles (f, 3) of triangles, and their normals, as long as their areas."""
    corner = np.asarray(vertices, np.float64)[faces]
    return corner.mean(1), np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2


def _frames(path: Path, asset: Similarity | None) -> Mapping[str, Similarity]:
    """{name: map to the unit frame}, the likeliest first: glTF and OBJ have +Y up, and PLY is what the stage writes."""
    y_up, same = Similarity(1.0, Y_UP.T), Similarity()
    unit = {"the frame of mesh.ply": same, "the frame of mesh.ply, +Y up": y_up}
    of_asset = {}
    if asset is not None:
        back = asset.inverse()
        of_asset = {"the frame of asset.glb": back, "the frame of asset.glb, +Z up": Similarity(1.0, Y_UP).then(back)}
    return {**unit, **of_asset} if path.suffix.lower() == ".ply" else {**of_asset, **dict(reversed(unit.items()))}
