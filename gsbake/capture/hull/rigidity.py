"""Whether masks are those of one rigid object: what its visual hull leaves out of the silhouettes.

A visual hull covers the silhouettes that it is made of, whatever the shape (Laurentini, *The visual hull concept for silhouette-based
image understanding*, PAMI 1994), as far as masks and poses are right and nothing moves. Where a lid or a hinge moved between photos, the
hull of all photos has only what all positions have in common, while that of photos of one position covers their silhouettes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull, unit_hull
from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster

Bytes = NDArray[np.uint8]

#: Longer side in pixels of the images in which hull and masks are compared.
COMPARED_SIZE = 256
#: A hull leaves out too much where it leaves out this share of the silhouettes or more, in the quantile of the photos. Of seven
#: captures with masks one with a lid that moved is above it, and one whose masks disagree within groups of photos too.
MIN_LEFT_OUT, QUANTILE = 0.005, 0.9
#: The object moved between groups of photos whose own hulls leave out less than this part of that; at most so many groups, of so many
#: photos, with hulls of so many cells along an edge.
OWN_PART, GROUPS, MIN_GROUP, GROUP_RESOLUTION = 0.25, 4, 8, 96


def left_out(hull: Hull, cameras: Sequence[Camera], masks: Sequence[Bytes]) -> NDArray[np.float64]:
    """Share (n,) of the silhouette in each photo that the `hull` leaves out, without a border of one cell.

    `cameras` are pinholes of the sizes of the `masks` (h, w), in the hull's frame.
    """
    if hull.empty:
        return np.ones(len(masks))
    caster, shares = RayCaster(*hull.triangles()), []
    middle = hull.lower + 0.5 * hull.cell * np.array(hull.occupancy.shape)
    for camera, mask in zip(cameras, masks, strict=True):
        small = camera.downscaled_to(COMPARED_SIZE)
        distance = max(float(np.linalg.norm(small.centre - middle)), hull.cell)  # a camera may be inside
        border = min(COMPARED_SIZE, math.ceil(small.fx * hull.cell / distance))
        inside = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA) > 127
        inside = cv2.erode(inside.astype(np.uint8), np.ones((2 * border + 1, 2 * border + 1), np.uint8)) > 0
        hit = caster.first_hit(small.centre[None], small.rays().reshape(-1, 3)).hit.reshape(inside.shape)
        shares.append(float((inside & ~hit).sum() / max(1, inside.sum())))
    return np.array(shares)


def moved_part(hull: Hull, cameras: Sequence[Camera], masks: Sequence[Bytes]) -> str | None:
    """A warning where a part of the object moved between photos: the `hull` of all leaves out much of the silhouettes, those of groups of
    consecutive photos do not. None otherwise; hulls leave out silhouettes as well where a part is outside many photos, or masks are wrong.

    `cameras` and `masks` (h, w) are those of the hull, in the order in which the photos were taken.
    """
    count = min(GROUPS, len(masks) // MIN_GROUP)
    if count < 2 or (much := float(np.quantile(left_out(hull, cameras, masks), QUANTILE))) < MIN_LEFT_OUT:
        return None
    own = 0.0
    for group in np.array_split(np.arange(len(masks)), count):
        chosen = [cameras[i] for i in group], [masks[i] for i in group]
        own = max(own, float(np.quantile(left_out(unit_hull(*chosen, GROUP_RESOLUTION), *chosen), QUANTILE)))
    if own > OWN_PART * much:
        return None
    return (
        f"The silhouettes are not those of one rigid object: the visual hull of all photos leaves out up to {much:.1%} of them, those of "
        f"{count} groups of consecutive photos up to {own:.1%}. A part has moved between photos, such as a lid or a hinge, and comes out "
        f"cut; give photos of one position, or masks without that part."
    )
