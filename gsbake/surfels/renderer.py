"""Renders a trained model outside training: G-buffers per camera for meshing, baking and figures (no gradients)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.surfels.gbuffer import rasterise, rendered_image
from gsbake.surfels.model import Surfels
from gsbake.surfels.views import TrainView, camera_tensors

Image = NDArray[np.float32]


class SurfelRenderer:
    """A trained model, loaded from the folder of the train or refine stage."""

    def __init__(self, surfels: Surfels, light: object | None) -> None:
        """`light` is an EnvironmentLight, or None for plain colours."""
        self.surfels, self.light = surfels, light

    @staticmethod
    def load(folder: Path, device: str = "cpu") -> SurfelRenderer:
        """Load `surfels.safetensors` and, when it is there, `light.safetensors`; the rasteriser runs on `device` ("cpu" or "cuda")."""
        light = None
        if (folder / "light.safetensors").exists():
            from gsbake.shading.environment import EnvironmentLight

            light = EnvironmentLight.load(folder / "light.safetensors").to(device)
        return SurfelRenderer(Surfels.load(folder / "surfels.safetensors").to(device), light)

    @torch.no_grad()
    def gbuffer(self, camera: Camera, projected: bool = False) -> dict[str, Image]:
        """Planes of one view as float32 arrays (h, w[, 3]); with `projected` the depths of the surfels moved onto the zero level set.

        "alpha"; "depth" (expected z-depth, alpha-normalised, 0 = none); "median_depth"; "normal" (unit frame, unit length, not
        flipped); and with materials "albedo" (linear), "roughness", "metallic", else "colour" (sRGB from this camera).
        """
        view = _view(camera, self.surfels.position.device)
        out = rasterise(self.surfels, view, distance=self.surfels.sdf if projected else None)
        alpha = out.alpha.clamp_min(1e-6)
        n = torch.nn.functional.normalize(out.features[-3:], dim=0, eps=1e-6)
        planes = {
            "alpha": out.alpha, "depth": out.expected_depth(), "median_depth": out.median, "normal": n.permute(1, 2, 0),
        }  # fmt: skip
        features = (out.features / alpha).permute(1, 2, 0)
        if self.surfels.pbr:
            planes |= {"albedo": features[..., :3], "roughness": features[..., 3], "metallic": features[..., 4]}
        else:
            planes["colour"] = features[..., :3].clamp(0, 1)
        return {k: np.ascontiguousarray(v.cpu().numpy(), np.float32) for k, v in planes.items()}

    @torch.no_grad()
    def photo(self, camera: Camera) -> tuple[Image, Image]:
        """Premultiplied sRGB picture (h, w, 3) and alpha (h, w) as training sees them."""
        view = _view(camera, self.surfels.position.device)
        out = rasterise(self.surfels, view)
        tables = None if self.light is None else self.light.prefilter()  # type: ignore[attr-defined]
        return rendered_image(out.planes, view, tables).permute(1, 2, 0).cpu().numpy(), out.alpha.cpu().numpy()


def _view(camera: Camera, device: torch.device) -> TrainView:
    r, t, centre, pinhole = camera_tensors(camera)
    return TrainView(camera.name, torch.empty(0), None, r, t, centre, pinhole).to(device)
