"""How like the photos the finished asset looks: PSNR and SSIM of photo against render.

Both pictures are laid over the same neutral grey, the photo by its mask and the render by its alpha, and compared where either shows the
object; so a missing or a superfluous part costs as much as a wrong colour, and empty background does not flatter the figure. Without masks
the photo's background is not modelled, and only what the asset covers is compared. SSIM is that of Wang et al., *Image quality assessment*,
IEEE TIP 2004, with Gaussian weights, averaged over the same pixels.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.posed_photos import View
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.imaging.metrics import psnr, ssim
from gsbake.report.render import Floats, Picture

#: Grey (sRGB value) behind photo and render.
GREY = 0.5


@dataclass(frozen=True)
class Likeness:
    """Result for one view: `psnr` in decibels over sRGB values, mean `ssim`, and both pictures (h, w, 3) as they were compared."""

    psnr: float
    ssim: float
    photo: Floats
    render: Floats


def compare(view: View, picture: Picture) -> Likeness:
    """Photo against render of the same camera and size."""
    photo = view.rgb.astype(np.float32) / np.float32(255)
    if view.mask is None:
        cover = picture.alpha
        where = cover > 0.5
    else:
        cover = view.mask.astype(np.float32) / np.float32(255)
        where = (cover > 0) | (picture.alpha > 0)
    shown = photo * cover[..., None] + np.float32(GREY) * (1 - cover[..., None])
    render = picture.over(GREY)
    # Without masks the comparison shows the whole photo; the figures look at the asset's pixels only.
    seen = photo if view.mask is None else shown
    return Likeness(psnr(shown, render, where), ssim(shown, render, where), seen, render)


def asset_cameras(path: Path) -> tuple[Camera, ...]:
    """Cameras of the asset's `cameras.json` (nerfstudio layout, asset frame, OpenGL axes), in the order of the poses stage's photos.

    Raises BadInputError when the file is not of that layout.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        out = []
        for frame in body["frames"]:
            both: dict[str, Any] = {**body, **frame}
            rotation, translation = Camera.pose_from_opengl(np.array(frame["transform_matrix"], float))
            fx, fy, cx, cy = (float(both[k]) for k in ("fl_x", "fl_y", "cx", "cy"))
            out.append(Camera(str(frame["file_path"]), int(both["w"]), int(both["h"]), fx, fy, cx, cy, rotation, translation))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise BadInputError(f"{path} does not list cameras in nerfstudio's layout ({error}); export the asset again.") from error
    return tuple(out)


def chosen_views(count: int, held_out: list[int], views: int) -> tuple[list[int], bool]:
    """Up to `views` of the held-out photos, evenly spread, or of all photos when none was held out; and whether they are held out."""
    pool = held_out or list(range(count))
    if len(pool) <= views:
        return pool, bool(held_out)
    picks = [pool[round((i + 0.5) * len(pool) / views - 0.5)] for i in range(views)]
    return sorted(set(picks)), bool(held_out)
