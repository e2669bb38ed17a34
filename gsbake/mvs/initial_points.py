"""Points for surfel initialisation: confident stereo points, and points of the carved visual hull (`gsbake.mvs.carving`) in their holes.

Hull points are used only where no stereo point is near and no depth map sees through them: a hull fills concavities that stereo has
measured, and the space before a measured surface is free.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.capture.hull.thin_parts import load_thin_parts
from gsbake.capture.hull.visual_hull import Hull
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Array, Camera
from gsbake.mvs.depth_maps import read_depth
from gsbake.mvs.point_cloud import StereoCloud

#: Stereo points below this confidence are not used.
MIN_CONFIDENCE = 0.15
#: With fewer stereo points than this, stereo initialisation is not used.
MIN_STEREO_POINTS = 200
#: A hull point fills a hole when the nearest stereo point is farther than this many spacings.
HOLE_SPACINGS = 2.5
#: A hull point is in free space when it lies before a measured depth by more than this many spacings, in this many photos.
FREE_SPACE_SPACINGS, MIN_FREE_SPACE_VIEWS = 1.5, 2


@dataclass(frozen=True)
class InitialPoints:
    """Oriented `points` (n, 3) in the unit frame, `normals` (n, 3), `colours` (n, 3) sRGB 0..1; the first `stereo` are stereo points."""

    points: Array
    normals: Array
    colours: Array
    stereo: int


def voxel_downsample(points: Array, normals: Array, colours: Array, weight: Array, count: int) -> tuple[Array, Array, Array]:
    """At most `count` points: weighted means over the cells of a voxel grid, separate for the six dominant directions of a normal."""
    if len(points) <= count:
        return points, normals, colours
    axis = np.abs(normals).argmax(1)
    face = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    lower, upper = 1e-4, float(np.ptp(points, axis=0).max()) + 1e-3
    for _ in range(18):
        size = np.sqrt(lower * upper)
        if len(np.unique(_cell_keys(points, face, size))) > count:
            lower = size
        else:
            upper = size
    _, cell = np.unique(_cell_keys(points, face, upper), return_inverse=True)
    total = np.bincount(cell, weight)
    mean = [np.stack([np.bincount(cell, weight * a[:, k]) / total for k in range(3)], 1) for a in (points, normals, colours)]
    length = np.linalg.norm(mean[1], axis=1, keepdims=True)
    return mean[0], mean[1] / np.maximum(length, 1e-9), mean[2]


def _cell_keys(points: Array, face: NDArray[np.int64], size: float) -> NDArray[np.int64]:
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


def in_free_space(points: Array, maps: Iterator[tuple[Camera, NDArray[np.float32]]], margin: float) -> NDArray[np.bool_]:
    """Which points (n, 3) lie before the measured depth by more than `margin` in at least MIN_FREE_SPACE_VIEWS photos."""
    votes = np.zeros(len(points), np.int64)
    for camera, depth in maps:
        pixel, z = camera.project(points)
        visible = camera.in_view(pixel, z)
        column, row = np.floor(pixel[visible]).astype(np.int64).T
        there = depth[row, column]
        votes[np.flatnonzero(visible)[(there > 0) & (z[visible] < there - margin)]] += 1
    return votes >= MIN_FREE_SPACE_VIEWS


def initial_points(posed: PosedPhotos, folder: Path, count: int, seed: int) -> InitialPoints | None:
    """At most `count` evenly spread stereo points from the stereo stage's `folder`, up to as many of its carved hull, and thin parts.

    None where stereo found too few. Hull points have the mean colour of the stereo points, since their own is unknown.
    """
    path = folder / "points.ply"
    if not path.exists():
        return None
    cloud = StereoCloud.load(path)
    cloud = cloud.select((cloud.confidence >= MIN_CONFIDENCE) & (np.linalg.norm(cloud.points, axis=1) < 1.1))
    if len(cloud) < MIN_STEREO_POINTS:
        return None
    points, normals, colours = voxel_downsample(cloud.points, cloud.normals, cloud.colours / 255.0, cloud.confidence, count)
    if not (folder / "hull.npz").exists():
        return InitialPoints(points, normals, colours, len(points))
    hull = Hull.load(folder / "hull.npz")
    tree = cKDTree(points)
    gap = float(np.median(tree.query(points, k=min(2, len(points)))[0][:, -1]))
    hull_points, hull_normals = hull.surface_points(count, seed)
    hole = tree.query(hull_points)[0] > HOLE_SPACINGS * gap
    hull_points, hull_normals = hull_points[hole], hull_normals[hole]
    if len(hull_points):
        solid = ~in_free_space(hull_points, depth_maps(posed, folder), FREE_SPACE_SPACINGS * gap)
        hull_points, hull_normals = hull_points[solid], hull_normals[solid]
    if (folder / "thin.npz").exists():
        thin_points, thin_normals = load_thin_parts(folder / "thin.npz")
        hull_points, hull_normals = np.concatenate([hull_points, thin_points]), np.concatenate([hull_normals, thin_normals])
    filled = np.broadcast_to(colours.mean(0), (len(hull_points), 3))
    return InitialPoints(
        np.concatenate([points, hull_points]), np.concatenate([normals, hull_normals]), np.concatenate([colours, filled]), len(points)
    )
