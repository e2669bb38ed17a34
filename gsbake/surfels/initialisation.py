"""Initialisation of surfels: from stereo points with the visual hull in their holes, SfM points, the visual hull, or a sphere.

The discretized SDF starts from a sphere of radius 1.1 (Zhu et al. 2025); initialisation near the surface needs far fewer steps.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.vectors import unit
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.spacing import typical_spacing

Floats = NDArray[np.float64]
#: Radius of the initial sphere (unit frame).
SPHERE_RADIUS = 1.1
#: Initial SDF sample of surfels on stereo points: the error of those points (unit frame).
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
    """Normals (n, 3) of a point cloud by PCA over 12 neighbours, oriented towards the nearest camera."""
    _, index = cKDTree(points).query(points, k=min(12, len(points)), workers=-1)
    local = points[index] - points[index].mean(1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    normal = vectors[:, :, 0]
    _, nearest = cKDTree(centres).query(points)
    flip = np.einsum("ni,ni->n", normal, centres[nearest] - points) < 0
    normal[flip] *= -1
    return np.asarray(normal)


def _sample_colours(posed: PosedPhotos, points: Floats, normals: Floats) -> Floats:
    """sRGB colours (n, 3) of the points in the photo that sees each most frontally; occlusion is ignored in these initial values."""
    cameras = posed.cameras.cameras
    facing = np.stack([np.einsum("ni,ni->n", normals, unit(c.centre - points)) for c in cameras])
    colours = np.full((len(points), 3), 0.5)
    best = facing.argmax(0)
    for i in np.unique(best):
        view = posed.view(int(i), 400)
        index = np.flatnonzero(best == i)
        uv, z = view.camera.project(points[index])
        x, y = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
        visible = (z > 0) & (x >= 0) & (y >= 0) & (x < view.camera.width) & (y < view.camera.height)
        colours[index[visible]] = view.rgb[y[visible], x[visible]] / 255.0
    return colours


def initialise_surfels(posed: PosedPhotos, train: Any, model: Any, seed: int, stereo: Path | None = None) -> tuple[Surfels, str, str]:
    """Initial surfels, their source ("stereo", "hull", "points", "sphere") and the evidence for it.

    `train` and `model` are the profile's sections, `stereo` is the folder of the stereo stage. "auto" takes stereo where it found enough
    points, then the hull when every photo has a mask, then SfM points (200 or more), then the sphere.
    """
    if train.init in ("auto", "stereo") and stereo is not None:
        initial = _from_stereo(posed, train, model, seed, stereo)
        if initial is not None:
            return initial
    cloud = posed.points()
    n_points = 0 if cloud is None else len(cloud[0])
    kind = train.init
    evidence = "set by the profile"
    if kind in ("auto", "stereo"):
        kind = "hull" if posed.has_masks else "points" if n_points >= 200 else "sphere"
        evidence = f"no stereo points; {'all' if posed.has_masks else 'not all'} photos have masks, {n_points} SfM points"
    if kind == "hull" and not posed.has_masks:
        kind, evidence = "sphere", "train.init = hull, but not every photo has a mask"
    if kind == "points" and n_points < 10:
        kind, evidence = "sphere", f"train.init = points, but there are only {n_points} SfM points"
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
    surfels = create(points, normals, gap, colours, model.shading, model.sh_degree, sdf, 1.0, model.transfer)
    return _spread(surfels, train, seed), kind, evidence


def _from_stereo(posed: PosedPhotos, train: Any, model: Any, seed: int, folder: Path) -> tuple[Surfels, str, str] | None:
    """Surfels on stereo points and on the hull in their holes, or None when stereo found too few points."""
    from gsbake.mvs.initial_points import initial_points

    initial = initial_points(posed, folder, min(train.init_surfels, model.max_count), seed)
    if initial is None:
        return None
    points, normals, colours = initial.points, initial.normals, initial.colours
    filled = len(points) - initial.stereo
    if filled:
        colours[initial.stereo :] = _sample_colours(posed, points[initial.stereo :], normals[initial.stereo :])
    gap = np.minimum(spacing(points), 0.3)
    evidence = f"{initial.stereo} evenly spread stereo points, {filled} hull points in their holes"
    # One SDF sample for all: at the initial sharpness of 1 all are opaque.
    surfels = create(points, normals, gap, colours, model.shading, model.sh_degree, STEREO_SDF, 1.0, model.transfer)
    return _spread(surfels, train, seed), "stereo", evidence


def _spread(surfels: Surfels, train: Any, seed: int) -> Surfels:
    """Spread the surfels over the band of `train.band` spacings around where they are, each with its distance from there as SDF sample, and
    start the sharpness where the widest has half the peak's opacity; unchanged where the unit of the sharpness is the unit frame."""
    if train.sharpness == "unit" and not train.band:
        return surfels
    gap = typical_spacing(surfels)
    width = max(train.band, train.final_width, 2 * float(surfels.sdf.abs().median()) / gap)
    if train.band:
        share = 2 * torch.rand(len(surfels), generator=torch.Generator().manual_seed(seed)) - 1
        surfels.sdf = train.band * gap * share
        surfels.position = surfels.position + surfels.sdf[:, None] * surfels.normal()
    if train.sharpness == "spacing":
        surfels.gamma = torch.tensor([surfels.transfer.half_width(0.5) / (width * gap)])
    return surfels
