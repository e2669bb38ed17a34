"""Views as the rasteriser takes them: a camera as tensors, and with it a photo in training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsbake.geometry.cameras import Camera
from gsbake.surfels.raster.projection import Pinhole


@dataclass(frozen=True)
class TrainView:
    """One photo at one size: `rgb` (3, h, w) sRGB and `mask` (h, w) or None as 8-bit tensors, world→camera pose, camera `centre`,
    intrinsics. Given priors, where there are any: `normals` (3, h, w) 8-bit signed in camera axes, `depths` (h, w), 0 where unknown."""

    name: str
    rgb: Tensor
    mask: Tensor | None
    R: Tensor
    t: Tensor
    centre: Tensor
    pinhole: Pinhole
    normals: Tensor | None = None
    depths: Tensor | None = None

    def to(self, device: str | torch.device) -> TrainView:
        """The view with all tensors on `device`."""
        mask = None if self.mask is None else self.mask.to(device)
        rgb, r, t, c = (x.to(device) for x in (self.rgb, self.R, self.t, self.centre))
        normals, depths = (x if x is None else x.to(device) for x in (self.normals, self.depths))
        return TrainView(self.name, rgb, mask, r, t, c, self.pinhole, normals, depths)

    def colour(self) -> Tensor:
        """Photo as sRGB floats (3, h, w) in 0..1."""
        return self.rgb.float() / 255

    def cover(self) -> Tensor | None:
        """Mask as floats (h, w) in 0..1, or None."""
        return None if self.mask is None else self.mask.float() / 255


def camera_tensors(camera: Camera) -> tuple[Tensor, Tensor, Tensor, Pinhole]:
    """float32 R (3, 3), t (3,), centre (3,) and intrinsics of a camera."""
    r, t, c = (torch.from_numpy(np.asarray(x, np.float32).copy()) for x in (camera.R, camera.t, camera.centre))
    return r, t, c, Pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
