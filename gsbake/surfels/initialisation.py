"""Where surfels start: stereo points with the visual hull in their holes, SfM points, the visual hull of the masks, or a sphere.

DSDF starts from a sphere of radius 1.1 (Zhu et al. 2025); a start near the surface needs far fewer steps.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.vectors import unit
from gsbake.surfels.model import Surfels, create

Floats = NDArray[np.float64]
SPHERE_RADIUS = 1.1
#: SDF sample of surfels on stereo points: how far they may be off (unit frame).
STEREO_SDF = 0.002


def fibonacci_sphere(count: int) -> Floats:
    """Evenly spread unit vectors (count, 3)."""
    i = np.arange(count) + 0.5
    phi, z = i * math.pi * (3 - math.sqrt(5)), 1 - 2 * i / count
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)


def spacing(points: Floats, neighbours: int = 3) -> Floats:
    """Mean distance (n,) to the nearest neighbours; 1 for a lone point."""
    if len(points) <= neighbours:
        return np.ones(len(points))
    distance, _ = cKDTree(points).query(points, k=neighbours + 1, workers=-1)
    return np.asarray(distance[:, 1:].mean(1))


def _cloud_normals(points: Floats, centres: Floats) -> Floats:
    """Normals of a point cloud by PCA over 12 neighbours, turned towards the nearest camera."""
    _, index = cKDTree(points).query(points, k=min(12, len(points)), workers=-1)
    local = points[index] - points[index].mean(1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    normal = vectors[:, :, 0]
    _, nearest = cKDTree(centres).query(points)
    flip = np.einsum("ni,ni->n", normal, centres[nearest] - points) < 0
    normal[flip] *= -1
    return np.asarray(normal)


def _sample_colours(posed: PosedPhotos, points: Floats, normals: Floats) -> Floats:
    """sRGB (n, 3) of each point in the photo that faces it best (occlusion ignored: a start value only)."""
    cameras = posed.cameras.cameras
    facing = np.stack([np.einsum("ni,ni->n", normals, unit(c.centre - points)) for c in cameras])
    colours = np.full((len(points), 3), 0.5)
    best = facing.argmax(0)
    for i in np.unique(best):
        view = posed.view(int(i), 400)
        mine = np.flatnonzero(best == i)
        uv, z = view.camera.project(points[mine])
        x, y = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
        ok = (z > 0) & (x >= 0) & (y >= 0) & (x < view.camera.width) & (y < view.camera.height)
        colours[mine[ok]] = view.rgb[y[ok], x[ok]] / 255.0
    return colours


def begin(posed: PosedPhotos, train: Any, model: Any, seed: int, stereo: Path | None = None) -> tuple[Surfels, str, str]:
    """Surfels to start from, the source taken ("stereo", "hull", "points", "sphere") and the evidence for it.

    `train` and `model` are the profile's sections, `stereo` is the folder of the stereo stage. With "auto" stereo wins where it found
    enough points, then the hull when every photo has a mask, then SfM points (200 or more), then the sphere.
    """
    if train.init in ("auto", "stereo") and stereo is not None:
        begun = _from_stereo(posed, train, model, seed, stereo)
        if begun is not None:
            return begun
    cloud = posed.points()
    n_points = 0 if cloud is None else len(cloud[0])
    kind = train.init
    why = "asked for by the profile"
    if kind in ("auto", "stereo"):
        kind = "hull" if posed.has_masks else "points" if n_points >= 200 else "sphere"
        why = f"no stereo points; {'all' if posed.has_masks else 'not all'} photos have masks, {n_points} SfM points"
    if kind == "hull" and not posed.has_masks:
        kind, why = "sphere", "a hull was asked for, but not every photo has a mask"
    if kind == "points" and n_points < 10:
        kind, why = "sphere", f"SfM points were asked for, but there are {n_points}"
    rng = np.random.default_rng(seed)
    colours: Floats | None
    if kind == "hull":
        from gsbake.capture.hull.visual_hull import visual_hull

        points, normals = visual_hull(posed).surface_points(train.init_surfels, seed)
        colours = _sample_colours(posed, points, normals)
        sdf = 0.01
    elif kind == "points" and cloud is not None:
        points, rgb = cloud
        if len(points) > model.max_count:
            keep = rng.permutation(len(points))[: model.max_count]
            points, rgb = points[keep], rgb[keep]
        centres = np.stack([c.centre for c in posed.cameras.cameras])
        normals = _cloud_normals(points, centres)
        colours, sdf = rgb / 255.0, 0.01
    else:
        points = SPHERE_RADIUS * fibonacci_sphere(train.init_surfels)
        normals, colours, sdf = points / SPHERE_RADIUS, None, 0.2
    gap = np.minimum(spacing(points), 0.3)
    return create(points, normals, gap, colours, model.shading, model.sh_degree, sdf, 1.0, model.transfer), kind, why


def _from_stereo(posed: PosedPhotos, train: Any, model: Any, seed: int, folder: Path) -> tuple[Surfels, str, str] | None:
    """Surfels on the stereo points and on the hull in their holes, or None when stereo found too few."""
    from gsbake.mvs.initial_points import start_points

    begun = start_points(posed, folder, min(train.init_surfels, model.max_count), seed)
    if begun is None:
        return None
    points, normals, colours = begun.points, begun.normals, begun.colours
    filled = len(points) - begun.stereo
    if filled:
        colours[begun.stereo :] = _sample_colours(posed, points[begun.stereo :], normals[begun.stereo :])
    gap = np.minimum(spacing(points), 0.3)
    why = f"{begun.stereo} evenly spread stereo points, {filled} hull points in their holes"
    # One sample for all: at the starting sharpness of 1 every one of them is opaque.
    return create(points, normals, gap, colours, model.shading, model.sh_degree, STEREO_SDF, 1.0, model.transfer), "stereo", why
