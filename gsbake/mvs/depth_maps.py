"""Depth maps that can be trusted: what other views confirm and none sees through, free of specks, inside the hull."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.hull.visual_hull import Hull
from gsbake.geometry.cameras import Camera
from gsbake.mvs.consistency import Agreement

Floats = NDArray[np.float32]

#: Costs (mean 1 − NCC) from which on a pixel is not even asked about.
WORST_COST = 0.6
#: A pixel falls when more views see through it than this share of those that agree with it.
THROUGH_SHARE = 0.34
#: Views beyond which one more makes a pixel no surer.
MANY_VIEWS = 5
#: Scatter of the agreeing depths (share of the depth) at which confidence halves.
SCATTER = 0.003
#: Pieces smaller than this share of the image's longer side squared are specks; neighbouring pixels of one piece differ by less than STEP.
SPECK, STEP = 2.5e-4, 0.01
#: Points farther outside the hull than this many of its cells are dropped.
HULL_CELLS = 1.5


@dataclass(frozen=True)
class DepthMap:
    """One photo's trusted depths: `camera`, `plane` (h, w, 3), `confidence` (h, w) in 0..1 (0 = no depth), `views` (h, w) that agree."""

    camera: Camera
    plane: Floats
    confidence: Floats
    views: NDArray[np.uint8]

    def depth(self) -> Floats:
        """z-depth (h, w), 0 = none."""
        return z_depth(self.camera, self.plane, self.confidence > 0)

    def save(self, path: Path) -> None:
        """Write depth and confidence as a NumPy archive."""
        np.savez(path, depth=self.depth(), confidence=self.confidence.astype(np.float16))


def read_depth(path: Path) -> tuple[Floats, Floats]:
    """z-depth (h, w; 0 = none) and confidence (h, w) in 0..1 that `DepthMap.save` wrote."""
    with np.load(path) as body:
        return body["depth"], body["confidence"].astype(np.float32)


def inverse_depth(camera: Camera, plane: Floats) -> Floats:
    """1/z (h, w) at the pixel centres of planes (h, w, 3)."""
    x = ((np.arange(camera.width) + 0.5 - camera.cx) / camera.fx).astype(np.float32)
    y = ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy).astype(np.float32)
    return np.asarray(plane[..., 0] * x[None, :] + plane[..., 1] * y[:, None] + plane[..., 2], np.float32)


def z_depth(camera: Camera, plane: Floats, keep: NDArray[np.bool_]) -> Floats:
    """z-depth (h, w) of planes (h, w, 3) where `keep` (h, w) says so and they lie before the camera, 0 elsewhere."""
    rho = inverse_depth(camera, plane)
    good = keep & (rho > 0)
    return np.where(good, 1 / np.where(good, rho, 1), 0).astype(np.float32)


def candidates(cost: Floats) -> NDArray[np.uint8]:
    """Pixels (h, w) whose match is worth asking other views about."""
    return (cost < WORST_COST).astype(np.uint8)


def confirmed(found: Agreement, least: int) -> NDArray[np.uint8]:
    """Pixels (h, w) with which at least `least` views agree and which few see through."""
    return ((found.agreeing >= least) & (found.through <= THROUGH_SHARE * found.agreeing)).astype(np.uint8)


def trusted(camera: Camera, cost: Floats, found: Agreement, least: int, hull: Hull | None) -> DepthMap:
    """The depth map of one photo after the last question; costs (h, w) are those of matching."""
    keep = confirmed(found, least) > 0
    rho = np.where(keep, inverse_depth(camera, found.plane), 0)
    keep &= rho > 0
    if hull is not None and keep.any():
        v, u = np.nonzero(keep)
        z = 1 / rho[v, u].astype(np.float64)
        local = np.stack([(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], 1)
        keep[v, u] = hull.signed_distance((local - camera.t) @ camera.R) < HULL_CELLS * hull.cell
    keep &= _no_specks(rho, keep)
    views = np.where(keep, found.agreeing, 0).astype(np.uint8)
    sure = np.minimum(found.agreeing / MANY_VIEWS, 1) * np.clip(1 - cost, 0, 1) / (1 + (found.scatter / SCATTER) ** 2)
    return DepthMap(camera, found.plane, np.where(keep, np.maximum(sure, 1e-3), 0).astype(np.float32), views)


def _no_specks(rho: Floats, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`keep` without small pieces whose inverse depth `rho` has no step."""
    if not keep.any():
        return keep
    # The filter counts in whole numbers: the logarithm of the depth makes STEP one difference everywhere.
    steps = np.log(np.where(keep, rho, 1)) / STEP * 100
    steps -= steps[keep].min() - 100
    image = np.where(keep, np.minimum(steps, 32000), 0).astype(np.int16)
    least = max(6, round(SPECK * max(rho.shape) ** 2))
    return np.asarray(cv2.filterSpeckles(image, 0, least, 100)[0] > 0)
