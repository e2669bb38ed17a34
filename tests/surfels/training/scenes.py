"""A striped ellipsoid, photos of it, and how far apart two cameras are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsbake.geometry.cameras import Camera
from gsbake.surfels.gbuffer import rasterise, rendered_image
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.views import TrainView
from tests.support.cameras import look_at_rotation

SIZE = 96
BACK = torch.tensor([0.2, 0.3, 0.5])


def ball(count: int = 3000) -> Surfels:
    """An ellipsoid (.8, .7, .6) of `count` surfels with coloured stripes: its image is different from every direction."""
    p = fibonacci_sphere(count)
    stripes = 0.5 + 0.4 * np.stack([np.sin(9 * p[:, 0]), np.sin(8 * p[:, 1] + 1), np.cos(7 * p[:, 2])], 1)
    axes = np.array([0.8, 0.7, 0.6])
    normals = p / axes
    return create(axes * p, normals / np.linalg.norm(normals, axis=1, keepdims=True), spacing(p), stripes, "colour", 0, 0.001, 4.5)


def view_from(eye: Tensor, name: str = "a") -> TrainView:
    """A camera at `eye` (3,) facing the origin, with a black photo."""
    rotation = torch.as_tensor(look_at_rotation(eye.numpy()), dtype=torch.float32)
    lens = Pinhole(SIZE, SIZE, 1.3 * SIZE, 1.3 * SIZE, 0.51 * SIZE, 0.49 * SIZE)
    return TrainView(name, torch.zeros(3, SIZE, SIZE, dtype=torch.uint8), None, rotation, -rotation @ eye, eye, lens)


def photographed(surfels: Surfels, view: TrainView) -> TrainView:
    """The view with its render of the surfels as photo and mask."""
    with torch.no_grad():
        out = rasterise(surfels, view)
        straight = rendered_image(out.planes, view, None) / out.alpha.clamp_min(0.05)
    rgb, mask = ((255 * x).round().clamp(0, 255).to(torch.uint8) for x in (straight, out.alpha))
    return replace(view, rgb=rgb, mask=mask)


def camera_of(view: TrainView) -> Camera:
    """The view's camera in double precision."""
    lens = view.pinhole
    return Camera("a", SIZE, SIZE, lens.fx, lens.fy, lens.cx, lens.cy, view.R.double().numpy(), view.t.double().numpy())


def pixels_apart(a: TrainView, b: TrainView) -> float:
    """Root mean square distance in pixels between the projections of a sphere by two cameras."""
    points = 0.7 * fibonacci_sphere(200)
    measured = [camera_of(view).project(points)[0] for view in (a, b)]
    return float(np.sqrt(((measured[0] - measured[1]) ** 2).sum(1).mean()))
