"""Points to start surfels from: stereo where it is sure, the opened visual hull (`gsbake.mvs.carving`) where stereo left holes.

Hull points are kept only where no stereo point lies near and no depth map sees through them: a hull bulges over concave places that stereo
has measured, and what lies before a measured surface is air.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.capture.hull.thin_parts import load_thin
from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.depth_maps import read_depth
from gsbake.mvs.point_cloud import StereoCloud

#: Stereo points below this confidence are no start.
LEAST_CONFIDENCE = 0.15
#: Fewer stereo points than this are no start at all.
LEAST_POINTS = 200
#: A hull point fills a hole when the next stereo point is farther than this many spacings.
HOLE = 2.5
#: A hull point is air when it lies before a measured depth by more than this many spacings, in this many photos.
AIR, AIR_PHOTOS = 1.5, 2


@dataclass(frozen=True)
class StartPoints:
    """Oriented points (n, 3) in the unit frame, `normals` (n, 3), `colours` (n, 3) sRGB 0..1; the first `stereo` come from stereo."""

    points: Array
    normals: Array
    colours: Array
    stereo: int


def thin(points: Array, normals: Array, colours: Array, weight: Array, count: int) -> tuple[Array, Array, Array]:
    """At most `count` points: weighted means over the cells of a grid, one for each of the six directions a normal can mostly have."""
    if len(points) <= count:
        return points, normals, colours
    axis = np.abs(normals).argmax(1)
    face = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    lower, upper = 1e-4, float(np.ptp(points, axis=0).max()) + 1e-3
    for _ in range(18):
        size = np.sqrt(lower * upper)
        if len(np.unique(_key(points, face, size))) > count:
            lower = size
        else:
            upper = size
    _, cell = np.unique(_key(points, face, upper), return_inverse=True)
    total = np.bincount(cell, weight)
    mean = [np.stack([np.bincount(cell, weight * a[:, k]) / total for k in range(3)], 1) for a in (points, normals, colours)]
    length = np.linalg.norm(mean[1], axis=1, keepdims=True)
    return mean[0], mean[1] / np.maximum(length, 1e-9), mean[2]


def _key(points: Array, face: NDArray[np.int64], size: float) -> NDArray[np.int64]:
    index = np.floor((points - points.min(0)) / size).astype(np.int64)
    width = index.max(0) + 1
    return ((index[:, 0] * width[1] + index[:, 1]) * width[2] + index[:, 2]) * 6 + face


def depth_maps(posed: PosedPhotos, folder: Path) -> Iterator[tuple[Camera, NDArray[np.float32]]]:
    """Cameras and z-depths (h, w; 0 = none) of the photos that have a depth map in the stereo stage's folder."""
    for camera in posed.cameras.cameras:
        path = folder / "depth" / f"{camera.name}.npz"
        if path.exists():
            depth, _ = read_depth(path)
            yield camera.scaled(depth.shape[1], depth.shape[0]), depth


def in_air(points: Array, maps: Iterator[tuple[Camera, NDArray[np.float32]]], margin: float) -> NDArray[np.bool_]:
    """Which points (n, 3) lie before the measured depth by more than `margin` in at least AIR_PHOTOS photos."""
    votes = np.zeros(len(points), np.int64)
    for camera, depth in maps:
        pixel, z = camera.project(points)
        seen = camera.shows(pixel, z)
        column, row = np.floor(pixel[seen]).astype(np.int64).T
        there = depth[row, column]
        votes[np.flatnonzero(seen)[(there > 0) & (z[seen] < there - margin)]] += 1
    return votes >= AIR_PHOTOS


def start_points(posed: PosedPhotos, folder: Path, count: int, seed: int) -> StartPoints | None:
    """At most `count` evenly spread points from the stereo stage's `folder`, up to as many from its opened hull, where there is one, and
    those on parts too thin for it.

    None where stereo found too few.
    The hull's points take the mean colour of the stereo points: nothing is known of theirs.
    """
    path = folder / "points.ply"
    if not path.exists():
        return None
    cloud = StereoCloud.load(path)
    cloud = cloud.select((cloud.confidence >= LEAST_CONFIDENCE) & (np.linalg.norm(cloud.points, axis=1) < 1.1))
    if len(cloud) < LEAST_POINTS:
        return None
    points, normals, colours = thin(cloud.points, cloud.normals, cloud.colours / 255.0, cloud.confidence, count)
    if not (folder / "hull.npz").exists():
        return StartPoints(points, normals, colours, len(points))
    hull = Hull.load(folder / "hull.npz")
    tree = cKDTree(points)
    gap = float(np.median(tree.query(points, k=min(2, len(points)))[0][:, -1]))
    more, more_normals = hull.surface_points(count, seed)
    hole = tree.query(more)[0] > HOLE * gap
    more, more_normals = more[hole], more_normals[hole]
    if len(more):
        solid = ~in_air(more, depth_maps(posed, folder), AIR * gap)
        more, more_normals = more[solid], more_normals[solid]
    if (folder / "thin.npz").exists():
        slight, slight_normals = load_thin(folder / "thin.npz")
        more, more_normals = np.concatenate([more, slight]), np.concatenate([more_normals, slight_normals])
    filled = np.broadcast_to(colours.mean(0), (len(more), 3))
    return StartPoints(
        np.concatenate([points, more]), np.concatenate([normals, more_normals]), np.concatenate([colours, filled]), len(points)
    )
