"""Texture coordinates that came with a mesh: checked, and kept as its atlas.

The asset has one square texture without overlaps, so several tiles (UDIM), stacked and tiled UVs are refused. Vertices that the file split
at seams are joined again: normals are smooth across seams, and hard edges come from the normal map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.texturing.atlas import CHECK_SIZE, Atlas, Floats, Ints, islands, signed_areas
from gsbake.texturing.texels import overlapping

#: How far outside the square UVs may lie, by rounding.
TOLERANCE = 1e-3
#: Largest UV: what lies beyond is none.
MAX_UV = 1e6
#: Largest share of the surface without area in the UVs: it has no texels.
MAX_FLAT = 0.01
#: Largest share of the texture's used area that several triangles may share.
MAX_OVERLAP = 0.005
#: Total area of the triangles' boxes, in squares, from which on looking for overlaps would take minutes.
MAX_BOXES = 200.0


@dataclass(frozen=True)
class GivenUVs:
    """A mesh of joined `vertices` (v, 3) and `faces` (f, 3) with the UVs of its corners, `uv` (f, 3, 2), in 0..1, origin top left.

    `notes` say what was changed, `faults` what the texture will lack.
    """

    vertices: Floats
    faces: Ints
    uv: Floats
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


def given_uvs(vertices: NDArray[Any], faces: NDArray[Any], uv: NDArray[Any] | None, materials: int = 1) -> GivenUVs | None:
    """The mesh of `vertices` (v, 3), `faces` (f, 3) and `uv` (v, 2), origin bottom left, of so many materials; None without UVs.

    `uv` is NaN where a part has none. UVs without any area are none. Raises ValueError, with a sentence that starts with a verb, for UVs
    that one texture cannot have.
    """
    if uv is None or np.isnan(uv).all():
        return None
    corner = np.asarray(uv, np.float64)[faces] * (1, -1) + (0, 1)
    usable = (np.abs(corner) <= MAX_UV).all((1, 2))
    if not usable.all():
        raise ValueError(f"has no UVs on {int((~usable).sum())} of its {len(usable)} triangles; unwrap all of it, or none")
    points, joined = np.unique(np.asarray(vertices, np.float32), axis=0, return_inverse=True)
    triangles = joined.ravel()[faces]
    area = _areas(points.astype(np.float64)[triangles])
    kept = area > 0
    notes = [f"{int((~kept).sum())} triangles without area are left out"] if not kept.all() else []
    triangles, corner, area = triangles[kept], corner[kept], area[kept]
    flat = np.abs(_uv_areas(corner)) <= 1e-12
    if flat.all():
        return None
    corner, moved = _in_one_square(corner)
    notes += moved
    share = float(area[flat].sum() / area.sum())
    if share > MAX_FLAT:
        raise ValueError(f"has UVs without area on {share:.0%} of its surface; unwrap all of it")
    faults = [f"{int(flat.sum())} triangles have no area in the UVs, so they have no texels of their own"] if flat.any() else []
    overlap = _overlap(corner)
    if overlap > MAX_OVERLAP:
        reason = f"its {materials} materials share one square; pack them side by side" if materials > 1 else "give each part its own place"
        raise ValueError(f"uses {overlap:.1%} of its texture's area more than once (overlapping or stacked UVs): {reason}")
    if materials > 1:
        notes.append(f"{materials} materials become one")
    return GivenUVs(points.astype(np.float64), triangles, corner, tuple(notes), tuple(faults))


def given_atlas(faces: NDArray[Any], corner_uv: NDArray[Any], size: int) -> Atlas:
    """The atlas of a mesh of `faces` (f, 3) whose corners have `corner_uv` (f, 3, 2), for a texture of `size` texels."""
    rows = np.concatenate([faces.reshape(-1, 1).astype(np.float64), corner_uv.reshape(-1, 2).astype(np.float32)], 1)
    unique, inverse = np.unique(rows, axis=0, return_inverse=True)
    corner, uv = inverse.reshape(-1, 3), np.ascontiguousarray(unique[:, 1:], np.float32)
    fill = float(np.abs(signed_areas(uv, corner)).sum())
    return Atlas(unique[:, 0].astype(np.int32), uv, corner.astype(np.int32), islands(len(uv), corner).astype(np.int32), size, fill)


def _areas(corner: Floats) -> Floats:
    """Areas (f,) of triangles with corners (f, 3, 3)."""
    return np.asarray(0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1))


def _uv_areas(corner: Floats) -> Floats:
    return signed_areas(corner.reshape(-1, 2), np.arange(3 * len(corner)).reshape(-1, 3))


def _in_one_square(corner: Floats) -> tuple[Floats, list[str]]:
    """The UVs (f, 3, 2) in 0..1, moved by whole squares where all lie in another one, and what was done. Raises ValueError."""
    low, high = corner.min((0, 1)), corner.max((0, 1))
    first = np.floor(low + TOLERANCE)
    if (high <= first + 1 + TOLERANCE).all():
        moved = [f"UVs moved into the square 0..1 from {_tile(first)}"] if first.any() else []
        return np.clip(corner - first, 0, 1), moved
    tile = np.floor(corner.mean(1))
    inside = (corner >= tile[:, None] - TOLERANCE) & (corner <= tile[:, None] + 1 + TOLERANCE)
    tiles = np.unique(tile, axis=0)
    if inside.all() and len(tiles) <= 100:
        names = ", ".join(_tile(t) for t in tiles[:4]) + (", …" if len(tiles) > 4 else "")
        raise ValueError(f"has UVs in {len(tiles)} tiles ({names}), but the asset has one texture; pack them into the square 0..1")
    raise ValueError(
        f"has UVs from {low[0]:.2f} to {high[0]:.2f} across and from {1 - high[1]:.2f} to {1 - low[1]:.2f} upwards, for a tiled texture; "
        "the asset has one texture: unwrap it into the square 0..1"
    )


def _tile(index: Floats) -> str:
    """Name of a square of the UV plane: the number that UDIM gives it, else its place."""
    u, v = int(index[0]), -int(index[1])  # v points down here
    return str(1001 + u + 10 * v) if 0 <= u < 10 and v >= 0 else f"({u}, {v})"


def _overlap(corner: Floats) -> float:
    """Share of the used area that more than one triangle uses. Raises ValueError where looking for it would take minutes."""
    covered = float(np.abs(_uv_areas(corner)).sum())
    if covered > 1 + 2 * MAX_OVERLAP:
        return (covered - 1) / covered
    if float(np.prod(corner.max(1) - corner.min(1), axis=1).sum()) > MAX_BOXES:
        raise ValueError("has UVs of many long oblique triangles; unwrap it into compact charts")
    shared = overlapping(corner.reshape(-1, 2), np.arange(3 * len(corner)).reshape(-1, 3), CHECK_SIZE)
    return shared / max(covered * CHECK_SIZE**2, 1)
