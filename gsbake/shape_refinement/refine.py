"""The whole refinement: silhouettes and patches first; then, where the photos' patches confirm little, parallax and reflections.

Masks are offset by the same amount everywhere, and surfels by as much: the first phase moves the surface as a whole, smoothly. Where
patches of the photos confirm enough of it, that is all. Elsewhere reflections are what the photos know of the shape: coarse light and
blurred photos first, then finer ones, a few Gauss–Newton steps each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.monitor import SILENT, Monitor
from gsbake.shape_refinement.appearance import Appearance, Geometry, choose_light_vertices, fit_appearance, fit_light, predicted_share
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Doubles, Floats, Photo, sample_photos
from gsbake.shape_refinement.step import PhotoRows, StepOptions, measure_rows, solve_step
from gsbake.shape_refinement.surface import Surface, surface_area
from gsbake.shape_refinement.targets import Targets, contour_targets

Faces = NDArray[np.int32]
#: A camera and its mask (h, w), 0..255.
Mask = tuple[Camera, NDArray[np.uint8] | None]
#: Measures patches of the photos at the vertices (v, 3) of a surface: targets, and the share of the vertices at which most photos agree.
PatchMeasure = Callable[[Surface, Doubles], tuple[Targets, float]]
#: Length in pixels of a refined mesh's edges: the photos say nothing between.
EDGE_PIXELS = 2.0
#: Radiance of the light at the start.
FIRST_RADIANCE = 0.5


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

    #: Steps of the first phase and their weights; share of confirmed vertices from which on there is no second phase.
    first_steps: int = 3
    first: StepOptions = field(default_factory=lambda: StepOptions(curvature=6.0, slope=8.0, move=3.0))
    confirmed: float = 0.07
    #: Least share of what changes between held-out photos that reflections fitted to the others must predict.
    predicted: float = 0.1
    levels: tuple[Level, ...] = (
        Level(16, 2, 2.0, held=False), Level(16, 2, 2.0), Level(24, 4, 1.4), Level(32, 6, 0.8), Level(48, 3, 0.6),
    )  # fmt: skip
    step: StepOptions = field(default_factory=StepOptions)
    #: Alternations of light and appearance at a level's first step, and at the others.
    first_alternations: int = 6
    alternations: int = 2
    #: Steps of a level between searches for contour points.
    contour_every: int = 3


@dataclass(frozen=True)
class Refined:
    """The refined `vertices` (v, 3), with figures of the first phase and, where there was a second one, of reflections."""

    vertices: Doubles
    figures: dict[str, float]


def refine_shape(
    vertices: Doubles,
    faces: Faces,
    load_photos: Callable[[float], Sequence[Photo]],
    masks: Callable[[], Iterable[Mask]] | None,
    pixel: float,
    measure_patches: PatchMeasure | None = None,
    options: RefinementOptions | None = None,
    *,
    seed: int = 0,
    threads: int = 2,
    on_step: Callable[[str, Doubles], None] = lambda text, vertices: None,
    monitor: Monitor = SILENT,
) -> Refined:
    """Refine the vertices (v, 3) of a mesh with outward `faces` (f, 3), in the frame of the cameras.

    `load_photos` returns the photos blurred by a number of pixels, the same cameras each time; `masks` yields the masks at their own size,
    None where not every photo has one; `pixel` is the size of a photo's pixel at the object (`pixel_size`).
    """
    options = options or RefinementOptions()
    if len(faces) == 0:
        return Refined(np.array(vertices, np.float64), {"confirmed": 0.0, "moved_pixels": 0.0})
    run = _Refinement(Surface(len(vertices), faces), np.array(vertices, np.float64), masks, pixel, options, seed, threads, monitor, on_step)
    if run.follow_targets(measure_patches) < options.confirmed:
        run.follow_photos(load_photos)
    run.contour()
    moved = float(np.linalg.norm(run.current - vertices, axis=1).mean() / pixel)
    return Refined(run.current, run.figures | {"moved_pixels": moved})


@dataclass
class _Refinement:
    """State of one refinement."""

    surface: Surface
    current: Doubles
    masks: Callable[[], Iterable[Mask]] | None
    pixel: float
    options: RefinementOptions
    seed: int
    threads: int
    monitor: Monitor
    on_step: Callable[[str, Doubles], None]
    figures: dict[str, float] = field(default_factory=dict)

    def contour(self) -> list[Targets]:
        """Targets of the contour points, where there are masks."""
        if self.masks is None:
            return []
        targets, offset = contour_targets(self.surface, self.current, self._checked(self.masks()), self.threads)
        self.figures = {"contour_before": offset} | self.figures | {"contour_after": offset}
        return [targets]

    def _checked(self, masks: Iterable[Mask]) -> Iterable[Mask]:
        """The masks, with a check for a stop request before each."""
        for mask in masks:
            self.monitor.check_stop()
            yield mask

    def move(self, text: str, displacement: Doubles) -> None:
        """Move the vertices along their normals by `displacement` (v,)."""
        self.current = self.current + self.surface.normals(self.current) * displacement[:, None]
        self.figures["step_pixels"] = float(np.abs(displacement).mean() / self.pixel)
        self.on_step(text, self.current)

    def follow_targets(self, measure_patches: PatchMeasure | None) -> float:
        """The first phase; the share of the vertices at which the photos' patches agree."""
        confirmed = 0.0
        for index in range(self.options.first_steps):
            self.monitor.check_stop()
            targets = self.contour()
            if measure_patches is not None:
                patches, confirmed = measure_patches(self.surface, self.current)
                targets.append(patches)
            self.move(f"silhouettes and patches {index}", solve_step(self.surface, self.current, self.pixel, targets, self.options.first))
        self.figures["confirmed"] = confirmed
        return confirmed

    def follow_photos(self, load_photos: Callable[[float], Sequence[Photo]]) -> None:
        """The second phase."""
        surface, options = self.surface, self.options
        count = surface.count
        total, variance = np.zeros(count), np.zeros(count, np.float32)
        robust: Floats | None = None
        appearance = Appearance.initial(count)
        light = ReflectionMap.constant(options.levels[0].light, FIRST_RADIANCE)
        targets: list[Targets] = []
        photos: Sequence[Photo] = ()
        blur = -1.0
        for level in options.levels:
            if level.blur != blur:
                photos = ()  # frees the last ones: all photos are most of the memory
                photos, blur = load_photos(level.blur), level.blur
            centres = np.stack([photo.camera.centre for photo in photos])
            robust = np.ones((count, len(photos)), np.float32) if robust is None else robust
            light = light.resampled(level.light) if light.size != level.light else light
            for index in range(level.steps):
                self.monitor.check_stop()
                geometry = Geometry(self.current, surface.normals(self.current), centres)
                samples = sample_photos(geometry.vertices, geometry.normals, surface.faces, photos)
                chosen = choose_light_vertices(samples, self.seed)
                if len(chosen) == 0:  # nothing tells reflections from colour
                    return
                if "predicted" not in self.figures:
                    self.figures["predicted"] = predicted_share(surface, geometry, samples, light, chosen, options.first_alternations)
                    if self.figures["predicted"] < options.predicted:
                        return
                for _ in range(options.alternations if index else options.first_alternations):
                    self.monitor.check_stop()
                    light = fit_light(geometry, samples, robust, appearance, light, chosen)
                    appearance = fit_appearance(surface, geometry, samples, robust, light)
                appearance = appearance.at_least(variance)
                if index % options.contour_every == 0:
                    targets = self.contour()
                rows: PhotoRows = measure_rows(surface, geometry, samples, robust, light, appearance, self.pixel)
                step = solve_step(surface, self.current, self.pixel, targets, options.step, rows, total if level.held else None)
                variance, total = rows.variance, total + step if level.held else total
                targets = [target.moved(step) for target in targets]
                self.figures |= {"explained": appearance.explained, "residual": rows.relative_residual}
                self.move(f"light {level.light} step {index}", step)


def pixel_size(vertices: Doubles, cameras: Sequence[Camera]) -> float:
    """Mean size of a pixel at the middle of the mesh."""
    middle = vertices.mean(0)
    return float(np.mean([np.linalg.norm(middle - camera.centre) * 2 / (camera.fx + camera.fy) for camera in cameras]))


def proxy_edge(vertices: Doubles, faces: Faces, pixel: float, most: int) -> float:
    """Length of the edges of a mesh for refinement: EDGE_PIXELS, longer where that makes more than about `most` vertices."""
    per_vertex = surface_area(vertices, faces) / most  # two triangles of √3/4 edge²
    return max(EDGE_PIXELS * pixel, (2 * per_vertex / np.sqrt(3)) ** 0.5)
