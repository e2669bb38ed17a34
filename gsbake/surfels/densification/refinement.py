"""Refinement between training and meshing: drop what the SDF, the silhouettes and visibility disown, and fill where the surface is
under-sampled.

Pruning by distance from the zero set takes the rule that `refine.prune` names (`policies.py`; by default none, see
docs/decisions/0008-densify-policies.md), seeding near the zero set where surfels are sparse follows GaussianRoom.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import BadInputError
from gsbake.surfels.densification.clone_split import OPACITY_FLOOR
from gsbake.surfels.densification.policies import PRUNING, Placement
from gsbake.surfels.initialisation import spacing
from gsbake.surfels.model import Surfels
from gsbake.surfels.raster.gbuffer import rasterise
from gsbake.surfels.training.views import TrainView, pose_of

#: Rendered weight a surfel needs in some view to count as seen.
SEEN_WEIGHT = 0.05
#: A neighbour gap wider than this many median gaps is under-sampled.
SPARSE = 1.6
#: Fewer surfels than this are no surface.
FEWEST = 10


def _visibility(surfels: Surfels, posed: PosedPhotos, max_size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Largest summed weight in any view (n,), views that disown the centre (outside the mask by 2 px), and mean |depth − z| of surfel
    against surface."""
    n = len(surfels)
    best, outside = torch.zeros(n), torch.zeros(n)
    error, hits = torch.zeros(n), torch.zeros(n)
    for i in range(len(posed)):
        view = posed.view(i, max_size)
        r, t, centre, pinhole = pose_of(view.camera)
        probe = surfels.select(torch.arange(n))
        probe.position = surfels.position.clone().requires_grad_()
        out = rasterise(probe, TrainView(view.camera.name, torch.empty(0), None, r, t, centre, pinhole))
        out.alpha.sum().backward()
        touched = out.stats.get("weight")
        if touched is not None:
            best = torch.maximum(best, touched)
        with torch.no_grad():
            cam = surfels.position @ r.T + t
            z = cam[:, 2]
            x = (pinhole.fx * cam[:, 0] / z.clamp_min(1e-3) + pinhole.cx).floor().long()
            y = (pinhole.fy * cam[:, 1] / z.clamp_min(1e-3) + pinhole.cy).floor().long()
            inside = (z > 0) & (x >= 0) & (y >= 0) & (x < pinhole.width) & (y < pinhole.height)
            xi, yi = x.clamp(0, pinhole.width - 1), y.clamp(0, pinhole.height - 1)
            if view.mask is not None:
                grown = cv2.dilate((view.mask > 64).astype(np.uint8), np.ones((5, 5), np.uint8))
                outside += inside & (torch.from_numpy(grown)[yi, xi] == 0)
            depth = out.expected_depth()[yi, xi]
            near = inside & (depth > 0) & ((depth - z).abs() < 0.1) & (touched > 0 if touched is not None else False)
            error += torch.where(near, (depth - z).abs(), 0.0)
            hits += near
    return best, outside, torch.where(hits > 0, error / hits.clamp_min(1), torch.full_like(error, 1.0))


def prune_and_densify(surfels: Surfels, posed: PosedPhotos, refine: Any, max_size: int, seed: int) -> tuple[Surfels, dict[str, int]]:
    """Surfels after pruning and seeding, and the count of each rule; `refine` is the profile's section, `max_size` the size of the
    probing renders. Raises BadInputError when next to nothing would be left."""
    before = len(surfels)
    if before < FEWEST:
        return surfels, {"before": before, "after": before}
    best, outside, distance = _visibility(surfels, posed, max_size)
    gap = torch.from_numpy(spacing(surfels.position.numpy().astype(float)).astype(np.float32))
    median_gap = float(gap.median())
    opacity = surfels.opacity() / surfels.transfer.peak
    measured = (best >= SEEN_WEIGHT) & (distance < 1.0)
    at = Placement(torch.where(measured, distance, 0.0), opacity, median_gap, refine.prune_distance * median_gap)
    rules = {
        "transparent": opacity < OPACITY_FLOOR,
        "unseen": best < SEEN_WEIGHT,
        "outside the silhouettes": outside >= 2,
        "far from the zero set": PRUNING[refine.prune](at) & measured,
        "floaters": gap > 8 * median_gap,
    }
    keep = ~torch.stack(list(rules.values())).any(0)
    counts = {"before": before} | {f"dropped, {k}": int(v.sum()) for k, v in rules.items()}
    kept = surfels.select(keep.nonzero()[:, 0])
    if len(kept) < FEWEST:
        worst = max(rules, key=lambda rule: int(rules[rule].sum()))
        raise BadInputError(
            f"refine: {before - len(kept)} of {before} surfels would be dropped, most of them as {worst}: training did not find the "
            "object; train longer (train.iterations) or start nearer to it (train.init=auto)."
        )
    added = _fill(kept, refine.densify_share, seed)
    counts["added"] = len(added)
    if len(added):
        kept = kept.concat(added)
    return kept, counts | {"after": len(kept)}


def _fill(surfels: Surfels, share: float, seed: int) -> Surfels:
    """New surfels half-way to the neighbours of those with wide gaps, moved onto the zero set μ − s n, with blended attributes."""
    p = surfels.position.numpy().astype(float)
    k = min(7, len(p))
    distance, index = cKDTree(p).query(p, k=k, workers=-1)
    mean = distance[:, 1:].mean(1)
    sparse = np.flatnonzero(mean > SPARSE * np.median(mean))
    room = int(share * len(p))
    if not len(sparse) or room <= 0:
        return surfels.select(torch.zeros(0, dtype=torch.long))
    if len(sparse) > room:
        sparse = np.random.default_rng(seed).permutation(sparse)[:room]
    sparse = np.sort(sparse)
    a, b = torch.from_numpy(sparse), torch.from_numpy(index[sparse, min(3, k - 1)])
    one, other = surfels.select(a), surfels.select(b)
    same_side = (one.normal() * other.normal()).sum(1) > 0.3
    one, other = one.select(same_side.nonzero()[:, 0]), other.select(same_side.nonzero()[:, 0])
    others = other.tensors()
    blended = {k: v if k in ("gamma", "quaternion") else (v + others[k]) / 2 for k, v in one.tensors().items()}
    middle = Surfels.from_tensors(blended, one.transfer)
    middle.position = middle.position - middle.sdf[:, None] * middle.normal()
    return middle
