"""The kernels against their plain twins, and each row against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from gsbake.shape_refinement import appearance as fitting
from gsbake.shape_refinement.reference import (
    moments_reference,
    reflection_reference,
    rows_reference,
    sample_reference,
)
from gsbake.shape_refinement.reflection_kernel import (
    KIND_COUNT,
    LOBE_COUNT,
    apply_light,
    gauss_newton_rows,
    locate_reflections,
    measure_moments,
)
from gsbake.shape_refinement.reflection_map import LOBES, ReflectionMap, laplacian, lobes
from gsbake.shape_refinement.samples import VertexSamples, sample_photos
from gsbake.shape_refinement.surface import tangents
from tests.shape_refinement.conftest import Ball


def _samples(ball: Ball, metal: float = 0.7, texture: float = 0.3) -> VertexSamples:
    return sample_photos(ball.vertices, ball.normals, ball.surface.faces, ball.photos(metal, texture))


def _direction(ball: Ball, v: int, j: int) -> np.ndarray:
    d = ball.centres[j] - ball.vertices[v]
    return d / np.linalg.norm(d)


def test_samples_and_slopes(ball: Ball) -> None:
    photos = ball.photos(0.7, 0.3)
    found = sample_photos(ball.vertices, ball.normals, ball.surface.faces, photos)
    seen = np.argwhere(found.weight > 0)
    assert 0.2 < len(seen) / found.weight.size < 0.55  # a sphere shows less than half of itself
    for v, j in seen[::97]:
        at, normal = ball.vertices[v], ball.normals[v]
        colour = sample_reference(at, photos[j].camera, photos[j].rgb)
        assert found.colour[v, j] == pytest.approx(colour, abs=1e-6)
        step = 1e-7
        forward, back = (sample_reference(at + s * step * normal, photos[j].camera, photos[j].rgb) for s in (1, -1))
        assert found.slope[v, j] == pytest.approx((forward - back) / (2 * step), abs=2e-4, rel=2e-3)
        cosine = _direction(ball, v, j) @ normal
        assert found.weight[v, j] == pytest.approx(cosine * (0.3 if colour.max() > 0.98 else 1), rel=1e-5)


def test_a_photo_does_not_see_what_is_behind(ball: Ball) -> None:
    photos = ball.photos(0.7, 0.3)
    found = sample_photos(ball.vertices, ball.normals, ball.surface.faces, photos)
    for j, camera in enumerate(ball.cameras):
        facing = ((camera.centre - ball.vertices) * ball.normals).sum(1) > 0
        assert not (found.weight[~facing, j] > 0).any()
    wall = np.concatenate([ball.vertices, 0.3 * ball.vertices + 0.5 * ball.cameras[0].centre])  # a ball before camera 0
    faces = np.concatenate([ball.surface.faces, ball.surface.faces + len(ball.vertices)]).astype(np.int32)
    hidden = sample_photos(wall, np.concatenate([ball.normals] * 2), faces, photos).weight[: len(ball.vertices), 0]
    assert (hidden[found.weight[:, 0] > 0] == 0).sum() > 100
    assert not (hidden[found.weight[:, 0] == 0] > 0).any()


def test_moments(ball: Ball) -> None:
    samples = _samples(ball)
    robust = np.random.default_rng(0).uniform(0.3, 1, samples.weight.shape).astype(np.float32)
    out = np.empty((len(ball.vertices), 7 + 9 * KIND_COUNT), np.float32)
    tables = ball.light.tables()
    measure_moments(0, len(out), ball.vertices, ball.normals, ball.centres, samples.colour, samples.weight, robust, tables, out)
    for v in range(0, len(out), 131):
        seen = np.flatnonzero(samples.weight[v])
        lights = np.array(
            [[reflection_reference(_direction(ball, v, j), ball.normals[v], tables, k) for k in range(KIND_COUNT)] for j in seen]
        )
        weights = samples.weight[v, seen].astype(float) * robust[v, seen]
        expected = moments_reference(weights, samples.colour[v, seen].astype(float), lights.reshape(-1, KIND_COUNT, 3))
        assert out[v] == pytest.approx(expected, rel=2e-4, abs=2e-5)


@pytest.mark.parametrize("kind", range(KIND_COUNT))
def test_rows_are_finite_differences(ball: Ball, kind: int) -> None:
    photos = ball.photos(0.7, 0.3)
    samples = sample_photos(ball.vertices, ball.normals, ball.surface.faces, photos)
    count = len(ball.vertices)
    draw = np.random.default_rng(1)
    scale, diffuse = draw.uniform(0.2, 1, (count, 3)).astype(np.float32), draw.uniform(0, 0.3, (count, 3)).astype(np.float32)
    variance = draw.uniform(0.01, 0.1, count).astype(np.float32)
    tables, frame, step = ball.light.tables(), tangents(ball.normals), 0.05
    robust, residual = np.ones_like(samples.weight), np.zeros((count, 2), np.float32)
    hessian, gradient = np.zeros((count, 4)), np.zeros((count, 3))
    gauss_newton_rows(
        0, count, ball.vertices, ball.normals, frame, ball.centres, samples.colour, samples.slope, samples.weight, robust, tables,
        np.full(count, kind), scale, diffuse, variance, step, hessian, gradient, residual,
    )  # fmt: skip
    for v in range(3, count, 211):
        seen = np.flatnonzero(samples.weight[v])
        if len(seen) < 2:
            continue

        def error(j: int, d: float, slope: np.ndarray, v: int = v) -> np.ndarray:
            colour = sample_reference(ball.vertices[v] + d * ball.normals[v], photos[j].camera, photos[j].rgb)
            normal = ball.normals[v] - slope @ frame[v]  # of a displacement with this gradient
            return colour - diffuse[v] - scale[v] * reflection_reference(_direction(ball, v, j), normal, tables, kind)

        zero = np.zeros(2)
        errors = np.array([error(j, 0.0, zero) for j in seen])
        rows = np.empty((len(seen), 3, 3))
        for r, j in enumerate(seen):
            rows[r, :, 0] = (error(j, 1e-7, zero) - error(j, -1e-7, zero)) / 2e-7
            for axis in range(2):
                tilt = step * np.eye(2)[axis]
                rows[r, :, 1 + axis] = (error(j, 0.0, tilt) - error(j, 0.0, -tilt)) / (2 * step)
        weights = samples.weight[v, seen].astype(float)
        damped = weights / (1 + (errors**2).sum(1) / (12 * variance[v]))  # Cauchy at two standard deviations
        assert robust[v, seen] * weights == pytest.approx(damped, rel=1e-4)
        wanted, pull = rows_reference(damped, errors, rows, float(variance[v]))
        assert hessian[v] == pytest.approx([wanted[0, 0], wanted[1, 1], wanted[1, 2], wanted[2, 2]], rel=5e-3, abs=5e-3)
        assert gradient[v] == pytest.approx(pull, rel=5e-3, abs=5e-3)
        assert residual[v, 0] == pytest.approx((weights * (errors**2).sum(1)).sum() / weights.sum(), rel=1e-4)


def _look(ball: Ball, seed: int) -> fitting.Appearance:
    draw, count = np.random.default_rng(seed), len(ball.vertices)
    return fitting.Appearance(
        np.zeros((count, 3), np.float32), draw.uniform(0.2, 1, (count, 3)).astype(np.float32), draw.integers(0, KIND_COUNT, count),
        np.ones(count, np.float32), draw.uniform(0.1, 0.5, count).astype(np.float32), 0.0,
    )  # fmt: skip


def test_light_equations(ball: Ball) -> None:
    """xᵀ(AᵀCWC(Ax + I)) is the weighted, centred product of the reflections of x with themselves plus the photos."""
    samples, look = _samples(ball), _look(ball, 2)
    draw = np.random.default_rng(4)
    robust = draw.uniform(0.3, 1, samples.weight.shape).astype(np.float32)
    rows = fitting.choose_light_vertices(samples, 0)[::64]
    first = np.concatenate([[0], np.cumsum((samples.weight[rows] > 0).sum(1))])
    place, factors = np.empty((first[-1], 2), np.int32), np.empty((first[-1], 4), np.float32)
    locate_reflections(
        0, len(rows), rows, ball.vertices, ball.normals, ball.centres, samples.weight, robust, look.kind, 6, first, place, factors
    )
    tables = draw.uniform(0, 1, (LOBE_COUNT, 64, 3)).astype(np.float32)
    entries = (rows, first, place, factors, look.kind, look.reflectance, look.importance, tables)
    for colour in (np.zeros((0, 0, 3), np.float32), samples.colour):
        out = np.zeros((LOBE_COUNT, 64, 3))
        apply_light(0, len(rows), *entries, colour, out)
        expected = 0.0
        for v in rows:
            seen = np.flatnonzero(samples.weight[v])
            weights = samples.weight[v, seen].astype(float) * robust[v, seen]
            padded = tables.reshape(LOBE_COUNT, 8, 8, 3)
            light = np.array([reflection_reference(_direction(ball, v, j), ball.normals[v], padded, int(look.kind[v])) for j in seen])
            light = light * look.reflectance[v]
            both = light + (samples.colour[v, seen] if len(colour) else 0)
            mean, mean_both = ((weights[:, None] * x).sum(0) / weights.sum() for x in (light, both))
            expected += look.importance[v] * (weights[:, None] * (light - mean) * (both - mean_both)).sum()
        assert float((tables * out).sum()) == pytest.approx(expected, rel=1e-4)


def test_the_light_is_found(ball: Ball, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos of known reflections give back their light, up to what they do not show."""
    samples, look = _samples(ball), _look(ball, 2)
    tables = ball.light.tables()
    for v, j in np.argwhere(samples.weight > 0):
        found = reflection_reference(_direction(ball, v, j), ball.normals[v], tables, int(look.kind[v]))
        samples.colour[v, j] = 0.2 + look.reflectance[v] * found
    monkeypatch.setattr(fitting, "LIGHT_SMOOTHNESS", 1e-5)
    monkeypatch.setattr(fitting, "LIGHT_ITERATIONS", 200)
    geometry = fitting.Geometry(ball.vertices, ball.normals, ball.centres)
    rows, robust = fitting.choose_light_vertices(samples, 0), np.ones_like(samples.weight)
    found = fitting.fit_light(geometry, samples, robust, look, ReflectionMap.constant(24, 0.4), rows)
    error, truth = found.radiance - ball.light.radiance, ball.light.radiance - ball.light.radiance.mean(0)
    error -= error.mean(0)  # what metals reflect of a constant looks like a diffuse colour
    assert np.sqrt((error**2).mean()) < 0.2 * np.sqrt((truth**2).mean())


def test_lobes_keep_a_constant_and_gather_is_the_transpose() -> None:
    light = ReflectionMap.constant(12, 0.7)
    for blurred in light.blurred():
        assert blurred == pytest.approx(0.7, rel=1e-5)
    draw = np.random.default_rng(3)
    values, radiance = draw.normal(size=(len(LOBES), 144, 3)).astype(np.float32), draw.normal(size=(144, 3)).astype(np.float32)
    left = sum(float((a * b).sum()) for a, b in zip(values, light.blurred(radiance), strict=True))
    assert left == pytest.approx(float((light.gathered(values) * radiance).sum()), rel=1e-4)
    for degrees, lobe in zip(LOBES, lobes(32), strict=True):
        if lobe is not None:
            from gsbake.shading.octahedral import texel_directions

            directions = texel_directions(32)
            angle = np.arccos(np.clip(directions @ directions[500], -1, 1))
            spread = np.degrees(np.sqrt((lobe[500] * angle**2).sum() / 2))  # per axis, for a narrow lobe
            assert spread == pytest.approx(degrees, rel=0.12)


def test_resampled_light_is_the_same_light(ball: Ball) -> None:
    finer = ball.light.resampled(32)
    from gsbake.shading.octahedral import texel_directions
    from tests.shape_refinement.conftest import smooth_light

    assert finer.radiance == pytest.approx(smooth_light(texel_directions(32)), abs=0.06)


def test_laplacian_of_the_sphere() -> None:
    matrix = laplacian(8).toarray()
    assert matrix == pytest.approx(matrix.T) and matrix.sum(0) == pytest.approx(0)
    assert (np.linalg.eigvalsh(matrix) > 1e-9).sum() == 63  # connected: only the constant is free
