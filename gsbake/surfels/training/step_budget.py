"""Training steps that can be skipped where stereo has confirmed the shape.

Surfels initialised on confirmed depths are already near the surface, so training needs fewer steps. Freezing the confirmed surfels instead
was measured to be worse (docs/decisions/0028-skip-rules.md): training still improves them.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.mvs.depth_maps import read_depth

#: Minimum share of the object that stereo confirmed for steps to be skipped.
MIN_CONFIRMED_SHARE = 0.5
#: Share of the steps skipped where stereo has confirmed the whole object.
MAX_SKIPPED_SHARE = 0.5


def confirmed_share(posed: PosedPhotos, folder: Path) -> float:
    """Share of the object's pixels (of all pixels, without masks) whose depth the stereo stage in `folder` confirmed; 0 without any."""
    confirmed = pixels = 0
    for index, camera in enumerate(posed.cameras.cameras):
        path = folder / "depth" / f"{camera.name}.npz"
        if not path.exists():
            continue
        depth, _ = read_depth(path)
        _, mask = posed.mask(index, max(depth.shape))
        # Stereo may match larger photos than the working ones.
        inside = np.ones(depth.shape, bool) if mask is None else cv2.resize(mask, depth.shape[::-1]) > 127
        confirmed += int(((depth > 0) & inside).sum())
        pixels += int(inside.sum())
    return confirmed / pixels if pixels else 0.0


def can_skip_steps(share: float, initialisation: str, materials: bool) -> tuple[bool, str]:
    """Whether steps can be skipped, and the evidence.

    `share` is that of `confirmed_share`, `initialisation` that of the surfels, `materials` whether they learn materials besides the shape.
    """
    if initialisation != "stereo":
        return False, f"initialisation from {initialisation}"
    if materials:
        return False, "learning materials needs all steps"
    return share >= MIN_CONFIRMED_SHARE, f"stereo confirmed {100 * share:.0f} % of the object; {100 * MIN_CONFIRMED_SHARE:.0f} % are needed"


def skipped_steps(iterations: int, share: float) -> int:
    """Number of the `iterations` that are skipped where stereo has confirmed `share` of the object."""
    return round(MAX_SKIPPED_SHARE * share * iterations)
