"""Contents of the report page: comparisons with held-out photos, renders under other environments, headline figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import encode
from gsbake.report.html import Comparison, Figure, Light, Panel, hdr_base64, image_uri
from gsbake.report.lights import PROCEDURAL_LIGHTS, LitShader, procedural
from gsbake.report.manifests import Manifests, peak, total_seconds
from gsbake.report.quality import ImageMetrics, compare
from gsbake.report.render import Asset, Renderer, Shader, unlit
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import LightMotion
from gsbake.text import duration, number, size

Array = NDArray[np.float64]

#: Gain in dB from which the PSNR with the exposure of each photo is shown too.
EXPOSURE_DECIBELS = 1.0
#: Difference of sRGB values that is brightest in the heat map.
ERROR_RANGE = 0.25
#: Height of the panorama of the light in pixels.
PANORAMA_HEIGHT = 256
#: Half the field of view (radians) of the cameras that show the whole asset.
HALF_ANGLE = math.radians(15)


@dataclass(frozen=True)
class ViewScore:
    """Image metrics of one photo against the render from its camera."""

    name: str
    held_out: bool
    metrics: ImageMetrics


def light_rotation(asset: Camera, unit: Camera) -> Array:
    """Rotation (3, 3) from the asset's frame to the unit frame, from the pose of one camera in both."""
    return np.asarray(unit.R.T @ asset.R)


def learnt_shader(light: Path, to_light: Array) -> LitShader:
    """Shader of the learnt environment map in the file `light` (safetensors, unit frame)."""
    return LitShader(EnvironmentLight.load(light), to_light)


def photo_shader(learnt: LitShader | None, motion: LightMotion) -> Callable[[int], Shader]:
    """The shader of each photo by its index: unlit without a learnt light, that light, or where it moves the light turned for it."""
    rotations = motion.rotations
    if learnt is None or learnt.to_light is None or rotations is None:
        return lambda index: learnt or unlit
    light, to_light = learnt.light, learnt.to_light
    return lambda index: LitShader(light, rotations[index] @ to_light)


def score_views(
    renderer: Renderer,
    shader: Callable[[int], Shader],
    posed: PosedPhotos,
    cameras: Sequence[Camera],
    indices: Sequence[int],
    held_out: bool,
    longest: int,
    progress: Callable[[int, int], None],
) -> list[ViewScore]:
    """Compare the photos `indices` with renders from their cameras (asset frame), at most `longest` pixels wide and high; `shader` gives
    that of a photo by its index."""
    out = []
    for done, index in enumerate(indices):
        view = posed.view(index, longest)
        image = renderer.draw(cameras[index].scaled(view.camera.width, view.camera.height), shader(index))
        out.append(ViewScore(view.camera.name, held_out, compare(view, image)))
        progress(done + 1, len(indices))
    return out


def comparisons(scored: Sequence[ViewScore]) -> tuple[Comparison, ...]:
    """Photo and render pairs of the page."""
    return tuple(
        Comparison(
            s.name, image_uri(s.metrics.photo), image_uri(s.metrics.render), s.metrics.psnr, s.metrics.ssim, s.held_out,
            image_uri(heat_map(s.metrics.photo, s.metrics.render)),
        )
        for s in scored
    )  # fmt: skip


def heat_map(photo: NDArray[np.floating], render: NDArray[np.floating]) -> NDArray[np.float32]:
    """Mean difference of two sRGB images (h, w, 3) in colours (h, w, 3): black is none, the brightest ERROR_RANGE and more."""
    import cv2

    error = np.abs(np.asarray(photo, np.float32) - np.asarray(render, np.float32)).mean(2)
    coded = np.asarray(np.rint(255 * np.clip(error / ERROR_RANGE, 0, 1)), np.uint8)
    return np.asarray(cv2.applyColorMap(coded, cv2.COLORMAP_INFERNO)[..., ::-1] / np.float32(255), np.float32)


def panorama(shader: LitShader, bake: Mapping[str, Any]) -> Panel:
    """The fitted light as an image, its 95th percentile white, and which factors on it the results of the `bake` leave open."""
    radiance = shader.equirectangular(PANORAMA_HEIGHT)
    white = max(float(np.quantile(radiance, 0.95)), 1e-6)
    low, high = (bake.get(f"light_factor_{end}") for end in ("low", "high"))
    certain = f"; a factor of {low:.2f} to {high:.2f} on it is open" if low and high and "white_factor" not in bake else ""
    return Panel("Fitted light", f"white is a radiance of {number(white)}{certain}", image_uri(encode(np.clip(radiance / white, 0, 1))))


def framing_camera(asset: Asset, direction: Array, pixels: int) -> Camera:
    """Square camera that shows the whole asset from `direction` (3,) (asset to camera, asset frame), +Y up."""
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
    """`count` directions (3,) from the asset to cameras of photos, chosen greedily far apart (farthest-point sampling)."""
    towards = np.array([c.centre - asset.centre for c in cameras])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # Prefer viewpoints slightly above the horizon, as in product photos.
    chosen = [int(np.argmin(np.abs(towards[:, 1] - 0.35)))]
    while len(chosen) < min(count, len(towards)):
        nearest = (towards @ towards[chosen].T).max(axis=1)
        chosen.append(int(np.argmin(nearest + 0.5 * np.abs(towards[:, 1] - 0.35))))
    return [towards[i] for i in chosen]


def relit_panels(
    renderer: Renderer, learnt: LitShader | None, directions: Sequence[Array], pixels: int, progress: Callable[[int, int], None]
) -> tuple[tuple[Panel, ...], tuple[Light, ...]]:
    """Renders under the learnt and the procedural environments, and these environments for the 3D view; unlit without `learnt`."""
    if learnt is None:
        shaders: dict[str, Shader] = {"As photographed": unlit}
        lights: tuple[Light, ...] = ()
    else:
        lit = {"Learnt light": learnt, **{name: procedural(name, learnt.light.size) for name in PROCEDURAL_LIGHTS}}
        shaders = dict(lit)
        lights = tuple(Light(name, hdr_base64(shader.equirectangular())) for name, shader in lit.items())
    panels = []
    total = len(shaders) * len(directions)
    for k, direction in enumerate(directions):
        camera = framing_camera(renderer.asset, direction, pixels)
        for name, shader in shaders.items():
            image = renderer.draw(camera, shader)
            panels.append(Panel(name, f"view {k + 1}", image_uri(image.rgb, image.alpha)))
            progress(len(panels), total)
    return tuple(panels), lights


def mean(values: Sequence[float]) -> float | None:
    """Arithmetic mean; None for no values."""
    return sum(values) / len(values) if values else None


def headline(
    manifests: Manifests, asset: Asset, bytes_: int, scored: Sequence[ViewScore], photos: tuple[int, int], density: Figure
) -> tuple[Figure, ...]:
    """Figures at the top of the page; `photos` = number of registered and of ingested photos."""
    kind = "test photos" if scored and scored[0].held_out else "training photos"
    psnr, ssim = mean([s.metrics.psnr for s in scored]), mean([s.metrics.ssim for s in scored])
    exposed = mean([s.metrics.exposed_psnr for s in scored])
    out = []
    if psnr is not None and ssim is not None and exposed is not None:
        out = [Figure("PSNR", f"{psnr:.2f} dB", f"on {len(scored)} {kind}"), Figure("SSIM", f"{ssim:.3f}")]
        if exposed > psnr + EXPOSURE_DECIBELS:
            out.insert(1, Figure("PSNR", f"{exposed:.2f} dB", "with the exposure of each photo"))
    height, width = asset.base_color.shape[:2]
    memory, stage = peak(manifests)
    out += [
        Figure("Photos", f"{photos[0]} of {photos[1]}", "registered"),
        Figure("Triangles", number(len(asset.faces))),
        Figure("Textures", f"{width}²" if width == height else f"{width} × {height}"),
        density,
        Figure("GLB", size(bytes_)),
        Figure("Time", duration(total_seconds(manifests)), "all stages"),
    ]
    if memory:
        out.append(Figure("Peak memory", size(memory), f"in {stage}"))
    return tuple(out)
