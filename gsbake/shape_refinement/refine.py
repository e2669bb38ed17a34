"""The whole refinement: coarse light and blurred photos first, then finer ones, a few Gauss–Newton steps each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.monitor import SILENT, Monitor
from gsbake.shape_refinement.appearance import Appearance, Geometry, choose_light_vertices, fit_appearance, fit_light
from gsbake.shape_refinement.contour import find_contour_points
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Doubles, Floats, Photo, sample_photos
from gsbake.shape_refinement.step import Contour, StepOptions, contour_rows, solve_step
from gsbake.shape_refinement.surface import Surface

Faces = NDArray[np.int32]
#: A camera and its mask (h, w), 0..255.
Mask = tuple[Camera, NDArray[np.uint8] | None]
#: Length in pixels of a refined mesh's edges: the photos say nothing between.
EDGE_PIXELS = 2.0
#: Level of the light at the start.
FIRST_LEVEL = 0.5


@dataclass(frozen=True)
class Level:
    """One level: edge of the light's map in texels, steps, blur of the photos in pixels; `held` = False lets the surface go where it will,
    because the start's error is the same everywhere."""

    light: int
    steps: int
    blur: float
    held: bool = True


@dataclass(frozen=True)
class RefinementOptions:
    """Settings of the refinement."""

    levels: tuple[Level, ...] = (Level(16, 2, 2.0, False), Level(16, 2, 2.0), Level(24, 4, 1.4), Level(32, 4, 0.8))
    step: StepOptions = field(default_factory=StepOptions)
    #: Alternations of light and appearance at a level's first step, and at the others.
    first_alternations: int = 6
    alternations: int = 2
    #: Steps between searches for contour points.
    contour_every: int = 3


@dataclass(frozen=True)
class Refined:
    """The refined `vertices` (v, 3), and what was found with them."""

    vertices: Doubles
    appearance: Appearance
    light: ReflectionMap
    figures: dict[str, float]


def refine_shape(
    vertices: Doubles,
    faces: Faces,
    load_photos: Callable[[float], Sequence[Photo]],
    masks: Callable[[], Iterable[Mask]] | None,
    options: RefinementOptions | None = None,
    *,
    seed: int = 0,
    threads: int = 2,
    on_step: Callable[[str, Doubles], None] = lambda text, vertices: None,
    monitor: Monitor = SILENT,
) -> Refined:
    """Refine the vertices (v, 3) of a mesh with outward `faces` (f, 3), in the frame of the cameras.

    `load_photos` returns the photos blurred by a number of pixels, the same cameras each time; `masks` yields the masks at their own size,
    None where not every photo has one.
    """
    options = options or RefinementOptions()
    surface = Surface(len(vertices), faces)
    current = np.array(vertices, np.float64)
    total, since_contour = np.zeros(len(current)), np.zeros(len(current))
    robust: Floats | None = None
    appearance = Appearance.initial(len(current))
    light = ReflectionMap.constant(options.levels[0].light, FIRST_LEVEL)
    variance = np.zeros(len(current), np.float32)
    contour: Contour | None = None
    figures: dict[str, float] = {}
    offsets: list[float] = []
    for level in options.levels:
        photos = load_photos(level.blur)
        centres = np.stack([photo.camera.centre for photo in photos])
        pixel = pixel_size(current, [photo.camera for photo in photos])
        robust = np.ones((len(current), len(photos)), np.float32) if robust is None else robust
        light = light.resampled(level.light) if light.size != level.light else light
        for index in range(level.steps):
            monitor.check_stop()
            normals = surface.normals(current)
            geometry = Geometry(current, normals, centres)
            samples = sample_photos(current, normals, faces, photos)
            chosen = choose_light_vertices(samples, seed)
            for _ in range(options.alternations if index else options.first_alternations):
                light = fit_light(geometry, samples, robust, appearance, light, chosen)
                appearance = fit_appearance(surface, geometry, samples, robust, light)
            appearance = appearance.at_least(variance)
            if masks is not None and index % options.contour_every == 0:
                contour, since_contour = _find_contour(surface, geometry, masks(), threads), np.zeros(len(current))
                offsets.append(contour.offset)
            step = solve_step(
                surface, geometry, samples, robust, light, appearance, total if level.held else None, pixel, contour, since_contour,
                options.step,
            )  # fmt: skip
            variance = step.variance
            total = total + step.displacement if level.held else total
            since_contour = since_contour + step.displacement
            current = current + normals * step.displacement[:, None]
            figures = {
                "explained": appearance.explained, "residual": step.relative_residual,
                "step_pixels": float(np.abs(step.displacement).mean() / pixel),
            }  # fmt: skip
            on_step(f"light {level.light} step {index}: " + ", ".join(f"{k} {v:.3f}" for k, v in figures.items()), current)
    figures["moved_pixels"] = float(np.linalg.norm(current - vertices, axis=1).mean() / pixel)
    if offsets:
        figures |= {"contour_before": offsets[0], "contour_after": offsets[-1]}
    return Refined(current, appearance, light, figures)


def _find_contour(surface: Surface, geometry: Geometry, masks: Iterable[Mask], threads: int) -> Contour:
    """Contour points of the mesh in all masks."""
    caster = RayCaster(geometry.vertices, surface.faces, threads)
    given = [(camera, mask) for camera, mask in masks if mask is not None]
    parts = [find_contour_points(caster, geometry.normals, surface.edges, camera, mask) for camera, mask in given]
    start, end, fraction, offset, pixel = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("start", "end", "fraction", "offset", "pixel")
    )
    median = float(np.median(offset)) if len(offset) else 0.0
    return Contour(contour_rows(start, end, fraction, surface.count), offset * pixel, pixel, median)


def pixel_size(vertices: Doubles, cameras: Sequence[Camera]) -> float:
    """Mean size of a pixel at the middle of the mesh."""
    middle = vertices.mean(0)
    return float(np.mean([np.linalg.norm(middle - camera.centre) * 2 / (camera.fx + camera.fy) for camera in cameras]))


def proxy_edge(vertices: Doubles, faces: Faces, pixel: float, most: int) -> float:
    """Length of the edges of a mesh for refinement: EDGE_PIXELS, longer where that makes more than about `most` vertices."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return max(EDGE_PIXELS * pixel, (2 * area / (np.sqrt(3) * most)) ** 0.5)  # a vertex has two triangles of √3/4 edge²
