"""Pruning and densification between training and fine-tuning: by visibility, silhouettes and distance, and gap filling.

Surfels far from the zero level set are pruned by the policy of `refine.prune` (by default none, see
docs/decisions/0008-densify-policies.md). Gap filling adds surfels on the zero level set where it is undersampled, after GaussianRoom.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import BadInputError
from gsbake.surfels.densification.clone_split import MIN_RELATIVE_OPACITY
from gsbake.surfels.densification.policy import PolicyInputs
from gsbake.surfels.densification.registry import PRUNING
from gsbake.surfels.field import Field
from gsbake.surfels.gbuffer import rasterise
from gsbake.surfels.initialisation import spacing
from gsbake.surfels.model import Surfels
from gsbake.surfels.views import TrainView, camera_tensors

#: Minimum blending weight of a visible surfel in at least one view.
MIN_VISIBLE_WEIGHT = 0.05
#: The surface is undersampled where the distance to the neighbours exceeds this many median distances.
MAX_GAP_RATIO = 1.6
#: Minimum number of surfels that represent a surface.
MIN_SURFELS = 10


def _measure_visibility(surfels: Surfels, posed: PosedPhotos, max_size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Largest summed blending weight in any view (n,), number of views (n,) whose mask excludes the centre by 2 px, and mean |depth − z|
    (n,) between surfel and rendered surface."""
    n = len(surfels)
    best, outside = torch.zeros(n), torch.zeros(n)
    error, hits = torch.zeros(n), torch.zeros(n)
    for i in range(len(posed)):
        view = posed.view(i, max_size)
        r, t, centre, pinhole = camera_tensors(view.camera)
        probe = surfels.select(torch.arange(n))
        probe.position = surfels.position.clone().requires_grad_()
        out = rasterise(probe, TrainView(view.camera.name, torch.empty(0), None, r, t, centre, pinhole))
        out.alpha.sum().backward()
        weight = out.stats.get("weight")
        if weight is not None:
            best = torch.maximum(best, weight)
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
            measured_here = inside & (depth > 0) & ((depth - z).abs() < 0.1) & (weight > 0 if weight is not None else False)
            error += torch.where(measured_here, (depth - z).abs(), 0.0)
            hits += measured_here
    return best, outside, torch.where(hits > 0, error / hits.clamp_min(1), torch.full_like(error, 1.0))


def prune_and_densify(
    surfels: Surfels, field: Field, posed: PosedPhotos, refine: Any, max_size: int, seed: int
) -> tuple[Surfels, dict[str, int]]:
    """Surfels after pruning and gap filling, and their number by rule; `field` is the one they were trained with, `refine` the profile's
    section, `max_size` the size of the renders that measure visibility. Raises BadInputError when fewer than MIN_SURFELS would be left."""
    before = len(surfels)
    if before < MIN_SURFELS:
        return surfels, {"before": before, "after": before}
    best, outside, distance = _measure_visibility(surfels, posed, max_size)
    gap = torch.from_numpy(spacing(surfels.position.numpy().astype(float)).astype(np.float32))
    median_gap = float(gap.median())
    opacity = surfels.opacity() / surfels.peak_opacity
    measured = (best >= MIN_VISIBLE_WEIGHT) & (distance < 1.0)
    inputs = PolicyInputs(torch.where(measured, distance, 0.0), opacity, median_gap, refine.prune_distance * median_gap)
    rules = {
        "transparent": opacity < MIN_RELATIVE_OPACITY,
        "unseen": best < MIN_VISIBLE_WEIGHT,
        "outside the silhouettes": outside >= 2,
        "far from the zero set": PRUNING[refine.prune](inputs) & measured,
        "floaters": gap > 8 * median_gap,
    }
    keep = ~torch.stack(list(rules.values())).any(0)
    counts = {"before": before} | {f"dropped, {k}": int(v.sum()) for k, v in rules.items()}
    kept = surfels.select(keep.nonzero()[:, 0])
    if len(kept) < MIN_SURFELS:
        worst = max(rules, key=lambda rule: int(rules[rule].sum()))
        raise BadInputError(
            f"refine: {before - len(kept)} of {before} surfels would be pruned, most of them as {worst}: training did not find the "
            "object; raise train.iterations or set train.init=auto."
        )
    added = _fill_gaps(kept, field, refine.densify_share, seed)
    counts["added"] = len(added)
    if len(added):
        kept = kept.concat(added)
    return kept, counts | {"after": len(kept)}


def _fill_gaps(surfels: Surfels, field: Field, share: float, seed: int) -> Surfels:
    """New surfels half-way between undersampled surfels and a neighbour, projected onto the zero level set, with the mean of their
    attributes; at most `share` of the surfels."""
    p = surfels.position.numpy().astype(float)
    k = min(7, len(p))
    distance, index = cKDTree(p).query(p, k=k, workers=-1)
    mean = distance[:, 1:].mean(1)
    sparse = np.flatnonzero(mean > MAX_GAP_RATIO * np.median(mean))
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
    with torch.no_grad():
        middle.position = field.project_surfels(middle)
    return middle
