"""Redundant photos: duplicates, and photos of dense sequences whose surface points other photos cover.

Frames of a video lie about a degree apart. Every later stage reads each of them, but depth comes from views some ten degrees apart and a
texel keeps its ten best views. Coverage as in Furukawa, Curless, Seitz, Szeliski, *Towards internet-scale multi-view stereo* (CVPR 2010):
a photo is redundant when the surface that it shows stays covered without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera

#: A view covers another at a point within this angle (degrees) between them, at this ratio of pixel sizes or better.
MAX_ANGLE, MIN_RESOLUTION_RATIO = 10.0, 0.8
#: Other views that must cover a point, and the share of a photo's points that must be covered for it to be redundant.
MIN_COVERING_VIEWS, MIN_COVERED_SHARE = 6, 0.98
#: Smaller sets are not thinned: in a hand-picked set each photo has a purpose.
MIN_SET_SIZE = 80
#: Duplicates agree in position within this share of the distance to the object, and in orientation within this angle (degrees).
DUPLICATE_DISTANCE, DUPLICATE_ANGLE = 0.01, 0.5
#: Photos that are kept in any case.
MIN_KEPT = 3
#: Cosine between normal and viewing direction above which a point is visible: about 75 degrees.
MIN_FACING_COSINE = 0.25


@dataclass(frozen=True)
class Coverage:
    """Visibility of k surface points in n photos: `visible` (n, k), unit `directions` towards the cameras (n, k, 3) float32, and
    `pixel_size` (n, k), the size of a pixel at the point."""

    visible: NDArray[np.bool_]
    directions: NDArray[np.float32]
    pixel_size: NDArray[np.float32]

    @staticmethod
    def from_cameras(cameras: Sequence[Camera], points: Array, normals: Array | None) -> Coverage:
        """Coverage of `points` (k, 3); with outward `normals` (k, 3) only points that face a camera are visible."""
        visible = np.zeros((len(cameras), len(points)), np.bool_)
        directions = np.zeros((len(cameras), len(points), 3), np.float32)
        pixel_size = np.ones((len(cameras), len(points)), np.float32)
        for i, camera in enumerate(cameras):
            pixel, z = camera.project(points)
            visible[i] = camera.in_view(pixel, z)
            offset = camera.centre - points
            length = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
            directions[i], pixel_size[i] = offset / length[:, None], length / camera.fx
            if normals is not None:
                visible[i] &= (directions[i] * normals).sum(1) > MIN_FACING_COSINE
        return Coverage(visible, directions, pixel_size)

    def covering_views(self, index: int) -> NDArray[np.int64]:
        """Number of other photos that cover photo `index` at each point (k,); 0 where the point is not visible in it."""
        return np.asarray((self._similar_direction(index) & (self.pixel_size * MIN_RESOLUTION_RATIO <= self.pixel_size[index])).sum(0))

    def covered_views(self, index: int) -> NDArray[np.bool_]:
        """Photos and points (n, k) at which photo `index` is one of the `covering_views`."""
        return self._similar_direction(index) & (self.pixel_size[index] * MIN_RESOLUTION_RATIO <= self.pixel_size)

    def _similar_direction(self, index: int) -> NDArray[np.bool_]:
        similar = np.einsum("nkc,kc->nk", self.directions, self.directions[index]) > np.cos(np.radians(MAX_ANGLE))
        similar &= self.visible & self.visible[index]
        similar[index] = False
        return np.asarray(similar)


def find_duplicate_poses(cameras: Sequence[Camera], duplicates: Mapping[str, str]) -> list[int]:
    """Indices of photos whose image and pose both equal those of another photo.

    `duplicates` maps the name of a photo to that of an earlier one with the same image (`quality.find_near_duplicates`). The pose is
    compared too, because a symmetric object on a turntable gives equal images at different poses, and these are not redundant.
    """
    index = {camera.name: i for i, camera in enumerate(cameras)}
    out = []
    for i, camera in enumerate(cameras):
        j = index.get(duplicates.get(camera.name, ""))
        if j is None:
            continue
        other = cameras[j]
        distance = np.linalg.norm(camera.centre - other.centre) / max(float(np.linalg.norm(camera.centre)), 1e-9)
        angle = np.degrees(np.arccos(np.clip((np.trace(camera.R @ other.R.T) - 1) / 2, -1, 1)))
        if distance < DUPLICATE_DISTANCE and angle < DUPLICATE_ANGLE:
            out.append(i)
    return out


def find_covered_photos(coverage: Coverage, kept: Sequence[int]) -> list[int]:
    """Indices of those of the photos `kept` that can be removed one after the other, each covered by the photos that remain."""
    remaining = np.zeros(len(coverage.visible), np.bool_)
    remaining[list(kept)] = True
    visible = coverage.visible & remaining[:, None]
    coverage = Coverage(visible, coverage.directions, coverage.pixel_size)
    covering = np.stack([coverage.covering_views(i) for i in range(len(visible))])
    points = np.maximum(visible.sum(1), 1)
    share = ((covering >= MIN_COVERING_VIEWS) & visible).sum(1) / points
    removed: list[int] = []
    # Greedy, densest neighbourhoods first: their removal leaves no gap.
    for i in np.argsort(-covering.sum(1) / points, kind="stable"):
        if not remaining[i] or share[i] < MIN_COVERED_SHARE or remaining.sum() <= MIN_KEPT:
            continue
        remaining[i] = False
        removed.append(int(i))
        covering -= coverage.covered_views(int(i))
        share = ((covering >= MIN_COVERING_VIEWS) & visible).sum(1) / points
    return sorted(removed)


def find_redundant_photos(
    cameras: Sequence[Camera], duplicates: Mapping[str, str], surface: Callable[[], tuple[Array, Array | None]], any_set_size: bool
) -> tuple[list[int], str]:
    """Indices of redundant photos, and the evidence.

    `cameras` are in the unit frame, `duplicates` is as in `find_duplicate_poses`. `surface()` returns points of the object (k, 3) and
    their normals (k, 3) or None; it is called only for sets of at least MIN_SET_SIZE photos, or with `any_set_size`.
    """
    duplicate = find_duplicate_poses(cameras, duplicates)
    evidence = f"{len(duplicate)} of {len(cameras)} photos are duplicates"
    kept = [i for i in range(len(cameras)) if i not in set(duplicate)]
    if len(kept) < MIN_KEPT:
        return [], f"{evidence}, but fewer than {MIN_KEPT} photos would remain"
    if len(kept) < MIN_SET_SIZE and not any_set_size:
        return duplicate, f"{evidence}; sets of fewer than {MIN_SET_SIZE} are not thinned"
    points, normals = surface()
    if len(points) == 0:
        return duplicate, f"{evidence}; no surface points are known to measure coverage"
    covered = find_covered_photos(Coverage.from_cameras(cameras, points, normals), kept)
    evidence += (
        f"; at {100 * MIN_COVERED_SHARE:.0f} % of their surface points {len(covered)} more are covered by {MIN_COVERING_VIEWS} others "
        f"within {MAX_ANGLE:g} degrees"
    )
    return sorted(duplicate + covered), evidence
