"""From a finished run to the page: comparisons at held-out photos, renders under other lights, headline figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera
from gsbake.report.html import Comparison, Figure, Light, Panel, hdr_base64, picture_uri
from gsbake.report.lights import PROCEDURAL, LitShader, procedural
from gsbake.report.manifests import Manifests, peak, total_seconds
from gsbake.report.quality import Likeness, compare
from gsbake.report.render import Asset, Renderer, Shader, unlit
from gsbake.shading.environment import EnvironmentLight
from gsbake.text import duration, size

Array = NDArray[np.float64]

#: Half the opening angle of the cameras that show the whole asset.
HALF_ANGLE = math.radians(15)


@dataclass(frozen=True)
class Scored:
    """The likeness of one photo and the asset."""

    name: str
    held_out: bool
    likeness: Likeness


def light_rotation(asset: Camera, unit: Camera) -> Array:
    """The rotation (3, 3) from the asset's frame to the unit frame, told by one camera in both."""
    return np.asarray(unit.R.T @ asset.R)


def learnt_shader(light: Path, to_light: Array) -> LitShader:
    """The shader of the learnt light in `light` (safetensors, unit frame)."""
    return LitShader(EnvironmentLight.load(light), to_light)


def score(
    renderer: Renderer,
    shader: Shader,
    posed: PosedPhotos,
    cameras: Sequence[Camera],
    indices: Sequence[int],
    held_out: bool,
    longest: int,
    progress: Callable[[int, int], None],
) -> list[Scored]:
    """Photo against render for the photos `indices` at `longest` pixels at most, each from its camera in the asset's frame."""
    out = []
    for done, index in enumerate(indices):
        view = posed.view(index, longest)
        picture = renderer.draw(cameras[index].scaled(view.camera.width, view.camera.height), shader)
        out.append(Scored(view.camera.name, held_out, compare(view, picture)))
        progress(done + 1, len(indices))
    return out


def comparisons(scored: Sequence[Scored]) -> tuple[Comparison, ...]:
    """The page's photo-and-render figures."""
    return tuple(
        Comparison(s.name, picture_uri(s.likeness.photo), picture_uri(s.likeness.render), s.likeness.psnr, s.likeness.ssim, s.held_out)
        for s in scored
    )


def framed(asset: Asset, direction: Array, pixels: int) -> Camera:
    """A square camera that sees the whole asset from `direction` (3,) (from the asset to the eye, asset frame), +Y up."""
    towards = direction / np.linalg.norm(direction)
    forward = -towards
    up = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    centre = asset.centre + towards * asset.radius / math.sin(HALF_ANGLE)
    focal = 0.5 * pixels / math.tan(HALF_ANGLE)
    return Camera("framed", pixels, pixels, focal, focal, pixels / 2, pixels / 2, rotation, -rotation @ centre)


def viewpoints(asset: Asset, cameras: Sequence[Camera], count: int) -> list[Array]:
    """`count` directions from the asset to the eye, spread over those the photos were taken from (the farthest-apart ones, greedily)."""
    towards = np.array([c.centre - asset.centre for c in cameras])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # Start a little above the horizon: that is how things are looked at.
    chosen = [int(np.argmin(np.abs(towards[:, 1] - 0.35)))]
    while len(chosen) < min(count, len(towards)):
        nearest = (towards @ towards[chosen].T).max(axis=1)
        chosen.append(int(np.argmin(nearest + 0.5 * np.abs(towards[:, 1] - 0.35))))
    return [towards[i] for i in chosen]


def relit_panels(
    renderer: Renderer, learnt: LitShader | None, directions: Sequence[Array], pixels: int, progress: Callable[[int, int], None]
) -> tuple[tuple[Panel, ...], tuple[Light, ...]]:
    """Renders of the asset under the learnt and the procedural lights, and those lights for the 3D view; unlit when `learnt` is None."""
    if learnt is None:
        shaders: dict[str, Shader] = {"As photographed": unlit}
        lights: tuple[Light, ...] = ()
    else:
        lit = {"Learnt light": learnt, **{name: procedural(name, learnt.light.size) for name in PROCEDURAL}}
        shaders = dict(lit)
        lights = tuple(Light(name, hdr_base64(shader.equirectangular())) for name, shader in lit.items())
    panels = []
    total = len(shaders) * len(directions)
    for k, direction in enumerate(directions):
        camera = framed(renderer.asset, direction, pixels)
        for name, shader in shaders.items():
            picture = renderer.draw(camera, shader)
            panels.append(Panel(name, f"side {k + 1}", picture_uri(picture.rgb, picture.alpha)))
            progress(len(panels), total)
    return tuple(panels), lights


def mean(values: Sequence[float]) -> float | None:
    """The mean, or None of nothing."""
    return sum(values) / len(values) if values else None


def headline(manifests: Manifests, asset: Asset, bytes_: int, scored: Sequence[Scored], photos: tuple[int, int]) -> tuple[Figure, ...]:
    """The figures at the top of the page; `photos` = placed and ingested."""
    kind = "held-out photos" if scored and scored[0].held_out else "training photos"
    psnr, ssim = mean([s.likeness.psnr for s in scored]), mean([s.likeness.ssim for s in scored])
    out = []
    if psnr is not None and ssim is not None:
        out = [Figure("PSNR", f"{psnr:.2f} dB", f"GLB against {len(scored)} {kind}"), Figure("SSIM", f"{ssim:.3f}")]
    height, width = asset.base_color.shape[:2]
    memory, stage = peak(manifests)
    out += [
        Figure("Photos", f"{photos[0]} of {photos[1]}", "placed"),
        Figure("Triangles", f"{len(asset.faces):,}".replace(",", " ")),
        Figure("Textures", f"{width}²" if width == height else f"{width} × {height}"),
        Figure("GLB", size(bytes_)),
        Figure("Time", duration(total_seconds(manifests)), "all stages"),
    ]
    if memory:
        out.append(Figure("Peak memory", size(memory), f"in {stage}"))
    return tuple(out)
