"""How well a surface predicts photos that its colours were not fitted to.

Diffuse colour is the mean of all photos but the one that it predicts. With reflections, it is fitted together with reflectance and distant
light to three quarters of the photos, and predicts the others. A surface in the wrong place shows each photo another colour; a glossy one
in the right place is predicted by its reflections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.kernels.threads import run_chunks
from gsbake.shape_refinement.appearance import BLACK, Appearance, Geometry, choose_light_vertices, fit_appearance, fit_light
from gsbake.shape_refinement.reflection_kernel import gauss_newton_rows
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Doubles, Floats, Photo, VertexSamples, sample_photos
from gsbake.shape_refinement.surface import Surface, tangents

#: Every so manieth photo is held out, from this one on.
EVERY, FIRST = 4, 2
#: Photos that a vertex's appearance has to be fitted to.
LEAST_VIEWS = 3
#: Edge of the light's map, its level at the start, alternations of light and appearance.
LIGHT_SIZE, LIGHT_LEVEL, ALTERNATIONS = 16, 0.5, 8
#: Least relative squared error that counts, and least vertices.
FLOOR, LEAST_VERTICES = 1e-5, 5


@dataclass(frozen=True)
class Prediction:
    """The `error` of a surface, the geometric mean of its vertices' relative squared errors, and by how many vertices `seen` it was
    measured; NaN and 0 for too few."""

    error: float
    seen: int

    @classmethod
    def of(cls, errors: Floats) -> Prediction:
        """That of the errors (v,) of vertices."""
        if len(errors) < LEAST_VERTICES:
            return cls(float("nan"), 0)
        return cls(float(np.exp(np.log(np.minimum(errors, 1) + FLOOR).mean())), len(errors))


def diffuse_errors(vertices: Doubles, faces: NDArray[np.int32], photos: Sequence[Photo]) -> Floats:
    """Squared error (v,) of photos, linear RGB, over the squared brightness, mean over photos and channels, when each is predicted by the
    mean of all others; NaN where too few see a vertex."""
    samples = sample_photos(vertices, Surface(len(vertices), faces).normals(vertices), faces, photos)
    weight = samples.weight
    total = np.maximum(weight.sum(1), 1e-9)
    mean = np.einsum("vp,vpc->vc", weight, samples.colour) / total[:, None]
    others = total[:, None] / np.maximum(total[:, None] - weight, 1e-9)
    square = np.square(samples.colour - mean[:, None]).mean(2) * others**2
    error = (weight * square).sum(1) / total / (mean.mean(1) + BLACK) ** 2
    return np.where((weight > 0).sum(1) > LEAST_VIEWS, error, np.nan).astype(np.float32)


def reflected_errors(vertices: Doubles, faces: NDArray[np.int32], photos: Sequence[Photo]) -> Floats:
    """As `diffuse_errors`, when every fourth photo is predicted by diffuse colour, reflectance and light fitted to the others."""
    held = np.arange(len(photos)) % EVERY == FIRST
    surface = Surface(len(vertices), faces)
    normals = surface.normals(vertices)
    geometry = Geometry(vertices, normals, np.stack([photo.camera.centre for photo in photos]))
    samples = sample_photos(vertices, normals, faces, photos)
    seen, asked = np.where(held, np.float32(0), samples.weight), np.where(held, samples.weight, np.float32(0))
    known = VertexSamples(samples.colour, samples.slope, np.ascontiguousarray(seen))
    robust = np.ones_like(seen)
    appearance, light = Appearance.initial(len(vertices)), ReflectionMap.constant(LIGHT_SIZE, LIGHT_LEVEL)

    def residual(weight: Floats, weights: Floats) -> Floats:
        """Squared residuals (v,) of the samples with this `weight`; `weights` get the robust ones."""
        hessian, gradient, out = np.zeros((len(vertices), 4)), np.zeros((len(vertices), 3)), np.zeros((len(vertices), 2), np.float32)
        fixed = (
            vertices, normals, tangents(normals), geometry.centres, samples.colour, samples.slope, np.ascontiguousarray(weight), weights,
            light.tables(), appearance.kind, appearance.reflectance, appearance.diffuse, appearance.variance, 0.5 * np.pi / light.size,
            hessian, gradient, out,
        )  # fmt: skip
        run_chunks(lambda start, stop: gauss_newton_rows(start, stop, *fixed), len(vertices))
        return out[:, 0]

    chosen = choose_light_vertices(known, 0)
    for index in range(ALTERNATIONS):
        light = fit_light(geometry, known, robust, appearance, light, chosen)
        appearance = fit_appearance(surface, geometry, known, robust, light)
        if index >= ALTERNATIONS // 2:
            residual(seen, robust)
    error = residual(asked, np.ones_like(asked)) * appearance.importance / 3
    enough = (asked.sum(1) > 0) & ((seen > 0).sum(1) >= LEAST_VIEWS)
    return np.where(enough, error, np.float32(np.nan))
