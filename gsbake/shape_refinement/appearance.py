"""Appearance in closed form: diffuse colour, reflectance and kind of each vertex, and the light, in turn.

For given light, a vertex's reflectance is the covariance of photo and reflected light over the light's variance, from moments averaged over
neighbours, and its kind the one that leaves the least residual. For given reflectances the light is a linear least-squares problem, solved
by conjugate gradients with the diffuse colours eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.threads import run_chunks
from gsbake.shading.octahedral import border_indices
from gsbake.shape_refinement.reflection_kernel import KIND_COUNT, LOBE_COUNT, apply_light, locate_reflections, measure_moments
from gsbake.shape_refinement.reflection_map import ReflectionMap, laplacian
from gsbake.shape_refinement.samples import Doubles, Floats, VertexSamples
from gsbake.shape_refinement.surface import Surface

#: Half-steps of averaging of the moments over neighbours.
AVERAGING_STEPS = 8
#: Share of the mean variance of the reflected light that is added to it: without contrast there is no reflectance.
RIDGE = 1e-3
#: Error of the model as a share of a vertex's brightness; the darkest count as BLACK.
MODEL_ERROR, BLACK = 0.015, 0.05
#: Least number of photos of a vertex that the light is fitted to, and most such vertices.
LIGHT_VIEWS, LIGHT_VERTICES = 4, 8_000
#: Weight of the light's smoothness as a share of its data, and of the pull to its mean.
LIGHT_SMOOTHNESS, LIGHT_PULL = 0.02, 1e-3
#: Iterations of conjugate gradients, and the reduction of the squared residual that ends them.
LIGHT_ITERATIONS, LIGHT_TOLERANCE = 12, 1e-4
#: Every so many photos one is predicted from the others.
VALIDATION_EVERY = 4
#: Reflectance at the start.
FIRST_REFLECTANCE = 0.3
#: Chunks of vertices whose sums are added in order: they do not depend on the number of threads.
_CHUNKS = 32


@dataclass(frozen=True)
class Appearance:
    """Per vertex: `diffuse` and `reflectance` (v, 3), `kind` (v,) int64 (see `reflection_kernel`), `variance` (v,) of a sample,
    `brightness` (v,) mean of its photos; `explained` is the share of the photos' variance that reflections explain."""

    diffuse: Floats
    reflectance: Floats
    kind: NDArray[np.int64]
    variance: Floats
    brightness: Floats
    explained: float

    @staticmethod
    def initial(count: int) -> Appearance:
        """What the first light is fitted with."""
        return Appearance(
            np.zeros((count, 3), np.float32), np.full((count, 3), FIRST_REFLECTANCE, np.float32), np.zeros(count, np.int64),
            np.ones(count, np.float32), np.ones(count, np.float32), 0.0,
        )  # fmt: skip

    def at_least(self, variance: Floats) -> Appearance:
        """The same with at least this variance (v,)."""
        return replace(self, variance=np.maximum(self.variance, variance))

    @property
    def importance(self) -> Floats:
        """Weight (v,) that makes residuals relative to the brightness."""
        return np.asarray(1 / (self.brightness + BLACK) ** 2, np.float32)


@dataclass(frozen=True)
class Geometry:
    """What the kernels read of the mesh and the photos: `vertices` and `normals` (v, 3), `centres` of the cameras (photos, 3)."""

    vertices: Doubles
    normals: Doubles
    centres: Doubles


def fit_appearance(surface: Surface, geometry: Geometry, samples: VertexSamples, robust: Floats, light: ReflectionMap) -> Appearance:
    """The appearance under `light`, with weights `robust` (v, photos) of the samples beside their own."""
    count = surface.count
    moments = _moments(geometry, samples, robust, light)
    mean, kinds = moments[:, 1:4], moments[:, 7:].reshape(count, KIND_COUNT, 3, 3)
    brightness = mean.mean(1)
    importance = (1 / (brightness + BLACK) ** 2)[:, None]
    relative = np.concatenate([moments[:, :1], moments[:, 4:7], kinds[:, :, 1:].reshape(count, -1)], 1) * importance
    averaged = surface.averaged(relative, AVERAGING_STEPS)
    weight, variance, sums = averaged[:, 0], averaged[:, 1:4], averaged[:, 4:].reshape(count, KIND_COUNT, 2, 3)
    light_variance, covariance = sums[:, :, 0], sums[:, :, 1]
    ridge = RIDGE * light_variance.mean(0, keepdims=True) + 1e-9
    reflectance = np.maximum(covariance / (light_variance + ridge), 0)
    residual = (variance[:, None] - 2 * reflectance * covariance + reflectance**2 * light_variance).sum(2)
    kind = residual.argmin(1)
    rows = np.arange(count)
    chosen = np.ascontiguousarray(reflectance[rows, kind], np.float32)
    least = np.maximum(residual[rows, kind], 0)
    per_sample = least / np.maximum(3 * weight, 1e-9) / importance[:, 0]
    total = float(variance.sum(dtype=float))
    return Appearance(
        np.ascontiguousarray(mean - chosen * kinds[rows, kind, 0], np.float32),
        chosen,
        kind.astype(np.int64),
        np.asarray(per_sample + (MODEL_ERROR * (brightness + BLACK)) ** 2, np.float32),
        np.asarray(brightness, np.float32),
        1 - float(least.sum(dtype=float)) / total if total > 0 else 0.0,
    )


def _moments(geometry: Geometry, samples: VertexSamples, robust: Floats, light: ReflectionMap) -> Floats:
    """What `measure_moments` fills (v, 7 + 9 · KIND_COUNT)."""
    moments = np.zeros((len(geometry.vertices), 7 + 9 * KIND_COUNT), np.float32)
    fixed = (geometry.vertices, geometry.normals, geometry.centres, samples.colour, samples.weight, robust, light.tables(), moments)
    run_chunks(lambda start, stop: measure_moments(start, stop, *fixed), len(moments))
    return moments


def predicted_share(
    surface: Surface, geometry: Geometry, samples: VertexSamples, light: ReflectionMap, rows: NDArray[np.int64], alternations: int
) -> float:
    """Share of the variance between every fourth photo that light and appearance fitted to the other photos explain, at most 1.

    It is near 0 or below where the light does not stay where it is with respect to the object, as on a turntable: a map of it then fits the
    photos that it is fitted to, and no others.
    """
    photos = samples.weight.shape[1]
    held = np.broadcast_to(np.arange(photos) % VALIDATION_EVERY == 1, (surface.count, photos))
    fitted, tested = (np.ascontiguousarray(part, np.float32) for part in (~held, held))
    appearance = Appearance.initial(surface.count)
    for _ in range(alternations):
        light = fit_light(geometry, samples, fitted, appearance, light, rows)
        appearance = fit_appearance(surface, geometry, samples, fitted, light)
    moments = _moments(geometry, samples, tested, light)
    variance = moments[:, 4:7].astype(float)
    chosen = moments[:, 7:].reshape(len(moments), KIND_COUNT, 3, 3)[np.arange(len(moments)), appearance.kind].astype(float)
    scale = appearance.reflectance.astype(float)
    left = variance - 2 * scale * chosen[:, 2] + scale**2 * chosen[:, 1]
    weight = appearance.importance.astype(float)
    total = float((weight * variance.sum(1)).sum())
    return 1 - float((weight * left.sum(1)).sum()) / total if total > 0 else 0.0


def fit_light(
    geometry: Geometry, samples: VertexSamples, robust: Floats, appearance: Appearance, light: ReflectionMap, rows: NDArray[np.int64]
) -> ReflectionMap:
    """The light, at least 0, that explains how the vertices `rows` change between the photos, starting from `light`."""
    if len(rows) == 0:
        return light
    size = light.size
    first = np.concatenate([[0], np.cumsum((samples.weight[rows] > 0).sum(1))]).astype(np.int64)
    place, factors = np.empty((first[-1], 2), np.int32), np.empty((first[-1], 4), np.float32)
    fixed = (geometry.vertices, geometry.normals, geometry.centres, samples.weight, robust, appearance.kind, size, first, place, factors)
    run_chunks(lambda start, stop: locate_reflections(start, stop, rows, *fixed), len(rows))
    entries = (rows, first, place, factors, appearance.kind, appearance.reflectance, appearance.importance)
    nothing = np.zeros((0, 0, 3), np.float32)
    bounds = np.linspace(0, len(rows), _CHUNKS + 1).astype(np.int64)

    def normal_equations(tables: Floats, colour: Floats) -> Floats:
        """AᵀCWC(A·tables + colour) as sums (lobes, size², 3) of the texels."""
        flat = np.ascontiguousarray(tables.reshape(len(tables), -1, 3))
        out = np.zeros((_CHUNKS, *flat.shape))

        def add(start: int, stop: int) -> None:
            for chunk in range(start, stop):
                apply_light(bounds[chunk], bounds[chunk + 1], *entries, flat, colour, out[chunk])

        run_chunks(add, _CHUNKS)
        return _fold(out.sum(0), size)

    zero = np.zeros((LOBE_COUNT, size + 2, size + 2, 3), np.float32)
    right = light.gathered(normal_equations(zero, samples.colour))

    def data(radiance: Floats) -> Floats:
        tables = replace(light, radiance=radiance).tables()
        return light.gathered(normal_equations(tables, nothing))

    probe = np.random.default_rng(0).choice(np.array([-1.0, 1.0], np.float32), right.shape)
    scale = float((probe * data(probe)).sum(dtype=float) / right.size)  # mean diagonal (Hutchinson's estimator)
    if not scale > 0:
        return light
    smooth, pull = LIGHT_SMOOTHNESS * scale, LIGHT_PULL * scale
    lattice = laplacian(size)

    def system(radiance: Floats) -> Floats:
        return np.asarray(data(radiance) + smooth * (lattice @ radiance) + pull * radiance, np.float32)

    solution = light.radiance
    residual = right + pull * light.radiance.mean(0, keepdims=True) - system(solution)
    direction, square = residual, float((residual.astype(float) ** 2).sum())
    least = LIGHT_TOLERANCE * square
    for _ in range(LIGHT_ITERATIONS):
        if square <= least:
            break
        image = system(direction)
        length = square / max(float((direction * image).sum(dtype=float)), 1e-30)
        solution, residual = solution + length * direction, residual - length * image
        new = float((residual.astype(float) ** 2).sum())
        direction, square = residual + (new / square) * direction, new
    return ReflectionMap(size, np.maximum(solution, 0).astype(np.float32))


def _fold(values: Doubles, size: int) -> Floats:
    """Sums (lobes, size², 3) of values (lobes, size + 2, size + 2, 3) in tables with a border."""
    index = border_indices(size).ravel()
    flat = values.reshape(len(values), -1, 3)
    out = np.empty((len(values), size * size, 3), np.float32)
    for lobe in range(len(values)):
        for c in range(3):
            out[lobe, :, c] = np.bincount(index, flat[lobe, :, c], minlength=size * size)
    return out


def choose_light_vertices(samples: VertexSamples, seed: int) -> NDArray[np.int64]:
    """Vertices (n,) that enough photos see to fit the light to, at most LIGHT_VERTICES, sorted."""
    seen = np.flatnonzero((samples.weight > 0).sum(1) >= LIGHT_VIEWS)
    draw = np.random.default_rng(seed)
    return np.sort(draw.choice(seen, min(LIGHT_VERTICES, len(seen)), replace=False))
