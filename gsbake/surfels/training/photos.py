"""Photos of a capture as training views at the working sizes, and how far their exposures differ."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from gsbake.capture.exposure import TiePointExposure
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode_bytes
from gsbake.surfels.views import TrainView, camera_tensors


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
