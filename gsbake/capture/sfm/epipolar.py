"""Agreement of given poses with matches: Sampson distances (Hartley & Zisserman, *Multiple View Geometry*, 11.4.3).

Matches are verified by a geometry of their own for each pair of photos, which knows nothing of the given poses. They tell errors of poses
where surfels cannot: reflections that move on a glossy object match badly, and look like an error of the cameras to anything that is
fitted to whole photos.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np

from gsbake.capture.colmap import pycolmap
from gsbake.capture.photos.undistortion import image_plane
from gsbake.geometry.cameras import Array, Camera

#: Smallest number of verified matches per photo, in the mean, that poses are judged by.
MIN_MATCHES = 20


def sampson_distances(first: Camera, second: Camera, points: Array, others: Array) -> Array:
    """Sampson distances (n,) in pixels of matched `points` (n, 2) of the `first` and `others` of the `second` photo, both given in the
    undistorted image plane (`image_plane`)."""
    rotation = second.R @ first.R.T
    x, y, z = second.t - rotation @ first.t
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    a, b = (np.column_stack([plane, np.ones(len(plane))]) for plane in (points, others))
    line_b, line_a = a @ essential.T, b @ essential
    slope = (line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1)
    focal = (first.fx + first.fy + second.fx + second.fy) / 4
    return np.asarray(focal * np.abs((b * line_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-24)))


def epipolar_error(database: Path, cameras: Mapping[str, Camera]) -> float | None:
    """Median over the pairs of photos of the median Sampson distance in pixels of their verified matches; `cameras` by photo name.

    None where there are fewer than `MIN_MATCHES` matches per photo: too few to tell.
    """
    medians, count = [], 0
    with closing(pycolmap.Database.open(str(database))) as base:
        images = {image.image_id: cameras[image.name.rsplit(".", 1)[0]] for image in base.read_all_images()}

        @cache
        def points(image: int) -> Array:
            return image_plane(images[image], np.asarray(base.read_keypoints(image), float)[:, :2])

        for i, j in combinations(sorted(images), 2):
            if base.exists_two_view_geometry(i, j):
                matches = np.asarray(base.read_two_view_geometry(i, j).inlier_matches, np.int64).reshape(-1, 2)
                if len(matches):
                    found = sampson_distances(images[i], images[j], points(i)[matches[:, 0]], points(j)[matches[:, 1]])
                    found = found[np.isfinite(found)]  # the lens of a given camera may not reach the edge of its photo
                    medians += [np.median(found)] if len(found) else []
                    count += len(found)
    return float(np.median(medians)) if medians and count >= MIN_MATCHES * len(cameras) else None
