"""How much of the shape stereo has settled before training, and how many steps that spares.

Surfels that start on confirmed depths already lie near where training would bring them; what is left to find is the rest of the object. So
there are fewer steps for all surfels. Holding the confirmed ones in place instead was measured to be worse (docs/skip.md): what training
moves them by is an improvement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.mvs.depth_maps import read_depth

#: Stereo must have confirmed this share of the object before steps are left out.
LEAST_SETTLED = 0.5
#: Share of the steps left out where stereo has confirmed all of it.
MOST_SPARED = 0.5


def settled_share(posed: PosedPhotos, folder: Path) -> float:
    """Share of the object's pixels (of all pixels, without masks) whose depth the stereo stage in `folder` confirmed; 0 without any."""
    confirmed = pixels = 0
    for index, camera in enumerate(posed.cameras.cameras):
        path = folder / "depth" / f"{camera.name}.npz"
        if not path.exists():
            continue
        depth, _ = read_depth(path)
        _, mask = posed.mask(index, max(depth.shape))
        inside = np.ones(depth.shape, bool) if mask is None else mask > 127
        confirmed += int(((depth > 0) & inside).sum())
        pixels += int(inside.sum())
    return confirmed / pixels if pixels else 0.0


def settles(share: float, start: str, materials: bool) -> tuple[bool, str]:
    """Whether steps can be left out, and the evidence.

    `share` is that of `settled_share`, `start` what the surfels start from, `materials` whether they learn materials besides the shape.
    """
    if start != "stereo":
        return False, f"surfels start from {start}"
    if materials:
        return False, "the surfels learn materials, which takes all steps"
    return share >= LEAST_SETTLED, f"stereo confirmed {100 * share:.0f} % of the object, {100 * LEAST_SETTLED:.0f} % are needed"


def spared_steps(iterations: int, share: float) -> int:
    """Steps of `iterations` that are left out where stereo has settled `share` of the object."""
    return round(MOST_SPARED * share * iterations)
