"""Training views: photos as 8-bit tensors at the working sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from gsbake.capture.photos.exposure import TiePointExposure
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode_bytes
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


def _to_view(camera: Camera, rgb: np.ndarray, mask: np.ndarray | None) -> TrainView:
    r, t, c, pinhole = camera_tensors(camera)
    planes = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))
    return TrainView(camera.name, planes, None if mask is None else torch.from_numpy(mask), r, t, c, pinhole)


def load_views(posed: PosedPhotos, max_size: int) -> tuple[list[TrainView], list[TrainView]]:
    """All photos at `max_size`, and the same at half of it (area filter)."""
    full, half = [], []
    for i in range(len(posed)):
        view = posed.view(i, max_size)
        full.append(_to_view(view.camera, view.rgb, view.mask))
        w, h = max(1, view.camera.width // 2), max(1, view.camera.height // 2)
        rgb = cv2.resize(view.rgb, (w, h), interpolation=cv2.INTER_AREA)
        mask = None if view.mask is None else cv2.resize(view.mask, (w, h), interpolation=cv2.INTER_AREA)
        half.append(_to_view(view.camera.scaled(w, h), rgb, mask))
    return full, half


def exposure_spread(posed: PosedPhotos, views: Sequence[TrainView]) -> float | None:
    """Factor within which the exposures of most photos lie at their tie points (`TiePointExposure.spread`); `views` are all photos."""
    tie_points = TiePointExposure.from_model(posed.folder / "sparse", posed.cameras.to_world.inverse())
    if tie_points is None:
        return None
    for camera, view in zip(posed.cameras.cameras, views, strict=True):
        planes = view.rgb.permute(1, 2, 0).cpu().numpy()
        tie_points.add(camera.downscaled_to(max(planes.shape)), decode_bytes(planes))
    return tie_points.spread()
