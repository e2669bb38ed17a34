"""Cameras that coincide although their photos differ: the sign of an object that moved before a background that did not.

A room ties the photos of a turntable to one camera; features of the object are then outliers, and registration looks complete.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsbake.capture.sfm.standing_background import moved_between
from gsbake.geometry.cameras import Array, Camera

#: Largest distance of cameras that coincide, as a share of that of the scene, and largest angle between them in radians: both move a small
#: photo by less than a pixel.
MAX_DISTANCE, MAX_ANGLE = 0.004, 0.004
#: Share of the cameras that coincide with others from which a solution is none, and how many of them are worth a warning.
MAX_COINCIDING, MIN_WARNED = 0.5, 4


def coinciding(cameras: Sequence[Camera], points: Array, files: Mapping[str, Path]) -> list[str]:
    """Names of cameras that coincide with another one whose photo differs; `points` (n, 3) of the scene, `files` of photos by name."""
    if len(cameras) < 2 or len(points) == 0:
        return []
    centres, rotations = np.array([c.centre for c in cameras]), np.array([c.R for c in cameras])
    scene = np.array([np.median(np.linalg.norm(points - centre, axis=1)) for centre in centres])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    cosine = (np.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    near = (apart < MAX_DISTANCE * np.minimum(scene[:, None], scene[None])) & (np.arccos(np.clip(cosine, -1, 1)) < MAX_ANGLE)
    found: set[str] = set()
    for first, second in np.argwhere(np.triu(near, 1)):
        names = cameras[first].name, cameras[second].name
        if not found.issuperset(names) and moved_between(files[names[0]], files[names[1]]):
            found.update(names)
    return sorted(found)
