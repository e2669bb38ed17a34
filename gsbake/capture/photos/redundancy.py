"""Photos that add nothing: the same photo saved twice, and one of many whose every place others show from the same side.

Frames of a video lie a degree apart; stereo, the field and the textures look at each of them, but depth comes from views some ten degrees
apart and a texel keeps its ten best views. Coverage as in Furukawa, Curless, Seitz, Szeliski, *Towards internet-scale multi-view stereo*
(CVPR 2010): a photo can go when what it sees stays seen well enough without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Array, Camera

#: Views of one place count as of the same side up to this angle (degrees), when they resolve it at least this finely in comparison.
SAME_SIDE, AS_FINE = 10.0, 0.8
#: A place is covered when this many other photos show it from the same side; a photo goes when this share of its places is.
ENOUGH, COVERED = 6, 0.98
#: Sets of fewer photos than this are not thinned: a person who took that few took each for a reason.
LEAST_PHOTOS = 80
#: A photo saved twice has the pose of the other within this share of the distance to the object and this angle (degrees).
SAME_PLACE, SAME_TURN = 0.01, 0.5
#: Never fewer photos than these are kept.
FEWEST = 3
#: A place is seen by photos that look at it within about 75 degrees of its normal.
FACING = 0.25


@dataclass(frozen=True)
class Coverage:
    """Of n photos and k places of the surface: which photo sees which (n, k), unit rays towards the photos (n, k, 3) float32, and the
    size of a pixel there (n, k)."""

    sees: NDArray[np.bool_]
    rays: NDArray[np.float32]
    pixel: NDArray[np.float32]

    @staticmethod
    def of(cameras: Sequence[Camera], points: Array, normals: Array | None) -> Coverage:
        """Coverage of `points` (k, 3); with outward `normals` (k, 3) only places that face a camera are seen by it."""
        sees = np.zeros((len(cameras), len(points)), np.bool_)
        rays = np.zeros((len(cameras), len(points), 3), np.float32)
        pixel = np.ones((len(cameras), len(points)), np.float32)
        for i, camera in enumerate(cameras):
            place, z = camera.project(points)
            sees[i] = camera.shows(place, z)
            ray = camera.centre - points
            length = np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
            rays[i], pixel[i] = ray / length[:, None], length / camera.fx
            if normals is not None:
                sees[i] &= (rays[i] * normals).sum(1) > FACING
        return Coverage(sees, rays, pixel)

    def counts(self, index: int) -> NDArray[np.int64]:
        """How many other photos show each place from the same side as photo `index` and as finely (k,); 0 where that sees nothing."""
        return np.asarray((self._same_side(index) & (self.pixel * AS_FINE <= self.pixel[index])).sum(0))

    def counts_for(self, index: int) -> NDArray[np.bool_]:
        """For which photos, and where, photo `index` is one of those that `counts` counts (n, k)."""
        return self._same_side(index) & (self.pixel[index] * AS_FINE <= self.pixel)

    def _same_side(self, index: int) -> NDArray[np.bool_]:
        near = np.einsum("nkc,kc->nk", self.rays, self.rays[index]) > np.cos(np.radians(SAME_SIDE))
        near &= self.sees & self.sees[index]
        near[index] = False
        return np.asarray(near)


def saved_twice(cameras: Sequence[Camera], alike: Mapping[str, str]) -> list[int]:
    """Indices of photos whose pose, too, is that of the photo they look like.

    `alike` maps the name of a photo to that of an earlier one with the same picture (`quality.near_duplicates`): from a
    turning, symmetric object two different poses show the same picture, and both say something.
    """
    index = {camera.name: i for i, camera in enumerate(cameras)}
    out = []
    for i, camera in enumerate(cameras):
        j = index.get(alike.get(camera.name, ""))
        if j is None:
            continue
        other = cameras[j]
        apart = np.linalg.norm(camera.centre - other.centre) / max(float(np.linalg.norm(camera.centre)), 1e-9)
        turn = np.degrees(np.arccos(np.clip((np.trace(camera.R @ other.R.T) - 1) / 2, -1, 1)))
        if apart < SAME_PLACE and turn < SAME_TURN:
            out.append(i)
    return out


def covered_by_others(seen: Coverage, kept: Sequence[int]) -> list[int]:
    """Of the photos `kept`, those that can go one after the other, each covered by the ones that stay at that moment."""
    alive = np.zeros(len(seen.sees), np.bool_)
    alive[list(kept)] = True
    sees = seen.sees & alive[:, None]
    seen = Coverage(sees, seen.rays, seen.pixel)
    others = np.stack([seen.counts(i) for i in range(len(sees))])
    places = np.maximum(sees.sum(1), 1)
    share = ((others >= ENOUGH) & sees).sum(1) / places
    gone: list[int] = []
    # The most crowded first: they leave no gap.
    for i in np.argsort(-others.sum(1) / places, kind="stable"):
        if not alive[i] or share[i] < COVERED or alive.sum() <= FEWEST:
            continue
        alive[i] = False
        gone.append(int(i))
        others -= seen.counts_for(int(i))
        share = ((others >= ENOUGH) & sees).sum(1) / places
    return sorted(gone)


def spare_photos(
    cameras: Sequence[Camera], alike: Mapping[str, str], surface: Callable[[], tuple[Array, Array | None]], whatever_count: bool
) -> tuple[list[int], str]:
    """Indices of the photos that add nothing, and the evidence.

    `cameras` live in the unit frame, `alike` is that of `saved_twice`, `surface()` gives places of the object (k, 3) and their normals
    (k, 3) or None; it is asked only where the set is large enough to be thinned, or with `whatever_count`.
    """
    twice = saved_twice(cameras, alike)
    evidence = f"{len(twice)} of {len(cameras)} photos are saved twice"
    kept = [i for i in range(len(cameras)) if i not in set(twice)]
    if len(kept) < FEWEST:
        return [], f"{evidence}, but too few would be left"
    if len(kept) < LEAST_PHOTOS and not whatever_count:
        return twice, f"{evidence}; sets of less than {LEAST_PHOTOS} are not thinned"
    points, normals = surface()
    if len(points) == 0:
        return twice, f"{evidence}; nothing is known of the surface that the others see"
    covered = covered_by_others(Coverage.of(cameras, points, normals), kept)
    evidence += (
        f"; {len(covered)} more show little that {ENOUGH} others do not ({100 * COVERED:.0f} % of it from within {SAME_SIDE:g} degrees)"
    )
    return sorted(twice + covered), evidence
