"""Surfels as oriented points of the surface: what moving least squares and the resolution of the distance field are made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.surfels.model import Surfels

Doubles = NDArray[np.float64]

#: Radius of the ball that contains the object: the unit sphere with a margin.
BALL_RADIUS = 1.05
#: Minimum opacity of a surfel, as a share of the transfer function's peak.
MIN_OPACITY = 0.05


@dataclass(frozen=True)
class OrientedPoints:
    """Surfels projected onto their zero set: `points` (n, 3), outward `normals` (n, 3), `weights` (n,) by area and opacity (median 1)."""

    points: Doubles
    normals: Doubles
    weights: Doubles


@torch.no_grad()
def oriented_points(surfels: Surfels) -> OrientedPoints:
    """Surfels inside the ball, moved by their SDF sample along their normal, with at least `MIN_OPACITY`; others are left out."""
    normal = surfels.normal().cpu().numpy().astype(np.float64)
    sdf = surfels.sdf.cpu().numpy().astype(np.float64).reshape(-1, 1)
    with np.errstate(invalid="ignore"):  # what is not finite is left out below
        points = surfels.position.cpu().numpy().astype(np.float64) - sdf * normal
    opacity = surfels.opacity().cpu().numpy().astype(np.float64).reshape(-1)
    weights = surfels.scale.cpu().numpy().astype(np.float64).prod(1) * opacity
    keep = np.isfinite(points).all(1) & np.isfinite(normal).all(1) & np.isfinite(weights)
    keep &= (np.linalg.norm(points, axis=1) <= BALL_RADIUS) & (opacity > MIN_OPACITY * surfels.peak_opacity)
    weights = weights[keep]
    return OrientedPoints(points[keep], normal[keep], weights / max(float(np.median(weights)) if len(weights) else 1.0, 1e-12))
