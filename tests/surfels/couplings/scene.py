"""A ball of surfels, photos of it, and fields beside it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from gsbake.config.schema import Coupling, DistanceField, Loss, Train
from gsbake.surfels.couplings.inputs import CouplingInputs
from gsbake.surfels.field import TrainingStep
from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.registry import make_field
from gsbake.surfels.gbuffer import rasterise
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.views import TrainView, camera_tensors
from tests.support.cameras import look_at

RADIUS, SIZE = 0.6, 40
SMALL = {
    "resolution": 32, "levels": 4, "table_bits": 12, "rank": 3, "octaves": 3, "width": 16, "fit_steps": 150, "rays": 200, "points": 400,
}  # fmt: skip


def ball(radius: float = RADIUS, count: int = 1500) -> Surfels:
    p = fibonacci_sphere(count)
    surfels = create(radius * p, p, radius * spacing(p), 0.5 + 0.4 * p, "colour", 0, 0.0, 50.0)
    surfels.attributes["opacity"] = torch.full((count,), 3.0)
    return surfels


def views(count: int = 4) -> list[TrainView]:
    made = []
    for i, eye in enumerate(2.5 * fibonacci_sphere(count)):
        r, t, centre, pinhole = camera_tensors(look_at(eye, size=SIZE, focal=50.0, name=f"{i}"))
        blank = TrainView(f"{i}", torch.zeros(3, SIZE, SIZE, dtype=torch.uint8), None, r, t, centre, pinhole)
        with torch.no_grad():
            out = rasterise(ball(), blank)
        rgb = (255 * out.planes[:3]).round().clamp(0, 255).to(torch.uint8)
        made.append(replace(blank, rgb=rgb, mask=(255 * out.alpha).round().clamp(0, 255).to(torch.uint8)))
    return made


def field_of(kind: str, radius: float = RADIUS, coupling: dict[str, float] | None = None, **settings: Any) -> ContinuousField:
    """A field that starts from a ball of this radius."""
    body = {"kind": kind, **SMALL} | settings
    profile = SimpleNamespace(field=DistanceField(**body), coupling=Coupling(**coupling or {}), loss=Loss(), train=Train())
    field = make_field(ball(radius), profile, 0)
    assert isinstance(field, ContinuousField)
    return field


def inputs(field: ContinuousField, surfels: Surfels, photos: list[TrainView], seed: int = 0, share: float = 0.5) -> CouplingInputs:
    field.follow(surfels)
    out = rasterise(surfels, photos[0])
    generator = torch.Generator().manual_seed(seed)
    return CouplingInputs(field, TrainingStep(surfels, out, share, True, generator, photos), photos[0])


def normals_of(view: TrainView, radius: float = RADIUS) -> np.ndarray:
    """True normals (3, h, w) in camera axes of a ball around the origin, 0 beside it."""
    p = view.pinhole
    x = (np.arange(p.width) + 0.5 - p.cx) / p.fx
    y = (np.arange(p.height) + 0.5 - p.cy) / p.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((p.height, p.width))], -1)
    centre = view.t.numpy().astype(float)  # of the ball in camera axes
    a, b, c = (rays**2).sum(-1), rays @ centre, centre @ centre - radius**2
    root = b * b - a * c
    z = (b - np.sqrt(np.maximum(root, 0))) / a
    n = (z[..., None] * rays - centre) / radius
    return np.where(root[..., None] > 0, n, 0).transpose(2, 0, 1)
