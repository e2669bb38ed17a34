"""Where the surface was seen by no photo, from where to photograph it, and the map of cameras around the object.

Directions for further photos are chosen greedily: each time the one from which most of the unseen surface is visible (Embree) at less than
60° to its normal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.geometry.region import EDGES, Region
from gsbake.imaging.exr import read_exr
from gsbake.report.render import Asset

Array = NDArray[np.float64]

#: Points of the surface on the map.
POINTS = 1500
#: Candidate directions; least cosine between a surface's normal and the direction it is photographed from.
DIRECTIONS, MIN_COSINE = 120, 0.5
#: Most directions that are proposed, and least share of the unseen surface that each shows.
MAX_PROPOSALS, MIN_GAIN = 3, 0.1
#: dB below the mean of the compared photos from which a view counts as weak.
WEAK = 3.0


@dataclass(frozen=True)
class SurfacePoints:
    """Points (n, 3) of the asset's surface with equal density, unit normals (n, 3), and whether a photo saw them (n,)."""

    position: Array
    normal: Array
    seen: NDArray[np.bool_]


def surface_points(asset: Asset, coverage: Path, count: int = POINTS) -> SurfacePoints | None:
    """Points of an asset with the coverage of its bake; None where there is none, as for a file of the user's."""
    if not coverage.exists():
        return None
    try:
        image = read_exr(coverage)
    except BadInputError:
        return None
    corner = asset.position[asset.faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(cross, axis=1)
    face = np.searchsorted(np.cumsum(area), (np.arange(count) + 0.5) / count * area.sum()).clip(0, len(area) - 1)
    uv = asset.uv[asset.faces[face]].mean(1)
    row, column = ((uv[:, k] * image.shape[1 - k]).astype(int).clip(0, image.shape[1 - k] - 1) for k in (1, 0))
    normal = cross[face] / np.maximum(area[face], 1e-30)[:, None]
    inside = image[row, column, 0] > 0.5
    if inside.mean() < 0.5:  # other texture coordinates than those of the bake
        return None
    return SurfacePoints(corner[face].mean(1), normal, image[row, column, 1] > 0.5)


def proposals(points: SurfacePoints, caster: RayCaster, radius: float) -> tuple[tuple[Array, float], ...]:
    """Directions (3,) to photograph the unseen surface from, each with the share of it that it shows; best first."""
    unseen = ~points.seen
    if not unseen.any():
        return ()
    position, normal = points.position[unseen], points.normal[unseen]
    k = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 2 * k / DIRECTIONS, math.pi * (1 + 5**0.5) * k
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.sin(turn), height, around * np.cos(turn)], 1)
    start = position + 1e-3 * radius * normal
    visible = np.zeros((DIRECTIONS, len(position)), bool)
    for index, direction in enumerate(directions):
        facing = normal @ direction > MIN_COSINE
        if facing.any():
            hits = caster.first_hit(start[facing], np.broadcast_to(direction, (int(facing.sum()), 3)).copy())
            visible[index, facing] = ~hits.hit
    left = np.ones(len(position), bool)
    found: list[tuple[Array, float]] = []
    while len(found) < MAX_PROPOSALS:
        gain = (visible & left).mean(1)
        best = int(gain.argmax())
        if gain[best] < MIN_GAIN:
            break
        found.append((directions[best], float(gain[best])))
        left &= ~visible[best]
    return tuple(found)


def in_words(direction: Array) -> str:
    """A direction from the object in words; the front is +Z, +Y is up."""
    elevation = math.degrees(math.asin(float(np.clip(direction[1], -1, 1))))
    azimuth = math.degrees(math.atan2(float(direction[0]), float(direction[2])))
    if abs(elevation) > 70:
        return "straight above" if elevation > 0 else "straight below"
    sides = ("the front", "the front right", "the right", "the back right", "the back", "the back left", "the left", "the front left")
    side = sides[round(azimuth / 45) % 8]
    return f"{side}, {abs(elevation):.0f}° {'above' if elevation >= 0 else 'below'} the horizon"


def map_json(
    asset: Asset, cameras: Sequence[Camera], points: SurfacePoints | None, psnr: dict[str, float], proposed: Sequence[tuple[Array, float]],
    region: Region | None = None,
) -> str:  # fmt: skip
    """What the page draws, as JSON: the surface, unseen parts of it, cameras with their PSNR, weak ones, proposed directions, and the edges
    of the region."""
    mean = sum(psnr.values()) / len(psnr) if psnr else 0.0
    centre, radius = asset.centre, max(asset.radius, 1e-30)

    def place(p: Array) -> list[float]:
        return [round(float(x), 4) for x in (p - centre) / radius]

    seen = np.ones(0, bool) if points is None else points.seen
    surface: list[Any] = [] if points is None else [[*place(p), int(s)] for p, s in zip(points.position, seen, strict=True)]
    views = []
    for camera in cameras:
        value = psnr.get(camera.name)
        weak = value is not None and value < mean - WEAK
        towards = [round(float(x), 4) for x in camera.view_direction]
        views.append({"name": camera.name, "at": place(camera.centre), "to": towards, "psnr": value, "weak": weak})
    new = [{"at": [round(2.5 * float(x), 4) for x in d], "share": round(share, 3)} for d, share in proposed]
    box = [] if region is None else [[place(region.corners[end]) for end in edge] for edge in EDGES]
    text = json.dumps({"surface": surface, "cameras": views, "proposed": new, "region": box}, separators=(",", ":"))
    return text.replace("<", "\\u003c")  # a photo's name must not close the script element
