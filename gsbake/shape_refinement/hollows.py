"""Hollows of a visual hull, opened where photos disagree about the colour of their lids.

A visual hull has a lid on every hollow, and stereo measures nothing in a hollow without texture. Photos disagree about the colour of a lid:
each sees another part of the hollow through it. A front moves inwards from the hull (`hollows_front`), a minimum cut goes back to the
surface that the photos agreed on most (`hollows_cut`), and photos that the front did not see decide about each hollow (`hollows_gate`).
All of it on blocks of the hull's cells and small photos: stereo measures the surface afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.visual_hull import Hull
from gsbake.imaging.srgb import encode
from gsbake.shape_refinement.hollows_front import Front, FrontOptions
from gsbake.shape_refinement.hollows_gate import Verdict, judge_regions
from gsbake.shape_refinement.samples import Photo

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class HollowOptions:
    """Settings."""

    #: Cells of the hull along the edge of a block; longer side of the photos in pixels.
    block: int = 2
    size: int = 100
    #: Rounds of so many steps of the front, each ended by a cut.
    rounds: int = 2
    steps: int = 30
    #: Softness (`gsbake.capture.hull.softness`) from which a part of the hull may be a lid.
    soft: float = 1.1
    #: Depth in cells of the hull that stays below other parts: the wall of a vessel.
    crust: float = 0.75
    #: Every so manieth photo is kept from the front, for the decision; the first of them.
    held_out: int = 4
    first_held_out: int = 2
    #: Longer side in pixels of the photos that decide.
    decision_size: int = 150
    front: FrontOptions = field(default_factory=FrontOptions)


def open_hollows(
    hull: Hull, softness: Floats, load_photos: Callable[[int], Sequence[Photo]], options: HollowOptions | None = None,
    *, on_cut: Callable[[str, Hull], None] = lambda text, opened: None,
) -> tuple[Hull, list[Verdict]]:  # fmt: skip
    """The hull (n, n, n) with its hollows opened, and what was decided about each.

    `softness` (n, n, n) as from `surface_softness`; `load_photos` returns the photos, their longer side at most a number of pixels, all
    with masks and always the same cameras. n is a multiple of the block. Raises ValueError for an empty hull.
    """
    options = options or HollowOptions()
    block = options.block
    photos = [replace(photo, rgb=np.asarray(encode(photo.rgb), np.float32)) for photo in load_photos(options.size)]
    held = np.arange(len(photos)) % options.held_out == options.first_held_out
    room = _blocks(_distance_to_hard(hull, softness, options.soft) - options.crust, block) / block
    blocks = _blocks(hull.field, block)
    front = Front(Hull(blocks < 0, hull.lower, hull.cell * block, blocks), np.asarray(room, np.float32))
    used = [photo for photo, kept in zip(photos, held, strict=True) if not kept]
    for number in range(options.rounds):
        for _ in range(options.steps):
            text = front.step(used, options.front)
        front.cut(options.front)
        on_cut(f"round {number}: {text}", front.hull())
    opened = _without(hull, front, block)
    verdicts, refused = judge_regions(hull, opened, load_photos(options.decision_size), held)
    return replace(hull, **_fields(np.where(refused, hull.field, opened.field))), verdicts


def _fields(values: NDArray[Any]) -> dict[str, Any]:
    """The fields of a Hull that depend on its distances."""
    return {"field": np.asarray(values, np.float32), "occupancy": values < 0}


def _distance_to_hard(hull: Hull, softness: Floats, soft: float) -> Floats:
    """Distance (n, n, n) in cells from the parts of the hull's surface that are not soft."""
    solid = hull.field < 0
    hard = solid & ~ndimage.binary_erosion(solid) & (softness < soft)
    if not hard.any():
        return np.full(solid.shape, float(max(solid.shape)), np.float32)
    return np.asarray(ndimage.distance_transform_edt(~hard), np.float32)


def _blocks(values: Floats, block: int) -> Floats:
    """Means of blocks of block³ cells."""
    n = values.shape[0] // block
    return np.asarray(values.reshape(n, block, n, block, n, block).mean((1, 3, 5)), np.float32)


def _without(hull: Hull, front: Front, block: int) -> Hull:
    """The hull without what the front removed."""
    index = (np.indices(hull.field.shape).astype(np.float32) + 0.5) / block - 0.5
    removed, distance = (
        ndimage.map_coordinates(values, index, order=1, mode="nearest") for values in (front.distance - front.least, front.distance)
    )
    cells = np.where(removed > 0.5, np.maximum(distance * front.start.cell, hull.field), hull.field)
    return replace(hull, **_fields(cells))
