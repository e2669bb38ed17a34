"""Materials fitted to pictures of a ball: paint, roughness and light come back.

Most pictures are made by the shading model that the fit inverts, which tests the fit alone; `reference` has them made by a Monte Carlo
renderer that shares no code with it, which tests the model too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode, encode
from gsbake.materials.adjacency import neighbours
from gsbake.materials.fit import FitSchedule, FitSurface, MaterialFit, Priors
from gsbake.materials.initialisation import TRIAL_PHOTO, trial_roughness
from gsbake.materials.pixels import SAMPLES, PixelReader, Pixels
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.split_sum import shade
from gsbake.texturing.resampling import Coarse
from gsbake.texturing.texels import Texels, rasterise
from tests.support.monte_carlo import render

SIZE = 64
LAMP = np.array([0.0, 0.5, 0.9], np.float32)
FREE = Priors(smooth=0.01, dark=0.0)


def ball() -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
    """An open latitude-longitude ball of radius 1 with its texture coordinates."""
    rows, columns = 24, 48
    v, u = np.meshgrid(np.linspace(0.04, 0.96, rows), np.linspace(0.02, 0.98, columns), indexing="ij")
    polar, turn = np.pi * v, 2 * np.pi * (u - 0.02) / 0.96
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return trimesh.Trimesh(points, faces, process=False), np.stack([u.ravel(), v.ravel()], 1)


def cameras(count: int, size: int = 48) -> list[Camera]:
    out = []
    for k in range(count):
        turn, high = 2.4 * k, 0.5 * np.sin(1.7 * k)
        centre = 4 * np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        right = np.cross(-centre, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(-centre / 4, right), -centre / 4])
        out.append(Camera(f"{k}", size, size, 1.7 * size, 1.7 * size, size / 2, size / 2, R, -R @ centre))
    return out


def room(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Dim walls with one window and a lamp."""
    window = np.exp(12 * (directions @ np.array([0.8, 0.0, 0.6]) - 1))
    lamp = np.exp(60 * (directions @ np.array([-0.6, 0.8, 0.0]) - 1))
    return (0.25 + 4 * window + 12 * lamp)[:, None] * np.ones(3)


class Scene:
    """A ball of two paints, or of all between them in an `even` spread, `roughness` all over, seen by `count` cameras.

    With `reference` the pictures are made by `tests.support.monte_carlo`."""

    def __init__(self, roughness: float, count: int = 12, even: bool = False, reference: bool = False) -> None:
        mesh, uv = ball()
        caster = RayCaster(mesh.vertices, mesh.faces, 1)
        self.texels: Texels = rasterise(uv, mesh.faces, SIZE)
        self.normal = self.texels.interpolate(np.asarray(mesh.vertices), mesh.faces)
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        # Stripes: a paint that followed the normal could be light as well.
        stripe = np.sin(5 * np.arctan2(self.normal[:, 1], self.normal[:, 0]) + 4 * self.normal[:, 2])[:, None]
        share = np.arcsin(stripe) / np.pi + 0.5 if even else stripe > 0
        self.paint = (share * [0.6, 0.2, 0.1] + (1 - share) * [0.05, 0.3, 0.4]).astype(np.float32)
        tables = EnvironmentLight.from_function(room, 16).prefilter()
        reader = PixelReader(caster, uv, self.texels, 2.0)
        self.photos: list[Pixels] = []
        for camera in cameras(count):
            blank = reader.read(camera, np.zeros((camera.height, camera.width, 3), np.uint8), None)
            paint, normal = (np.einsum("nk,nkc->nc", blank.share, x[blank.texel]) for x in (self.paint, self.normal))
            n = len(blank)
            if reference:
                unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
                linear = render(unit, blank.towards, paint, np.full(n, roughness), np.zeros(n), room)
            else:
                with torch.no_grad():
                    n_, paint_ = torch.as_tensor(normal, dtype=torch.float32), torch.as_tensor(paint, dtype=torch.float32)
                    linear = shade(n_, torch.as_tensor(blank.towards), paint_, torch.full((n,), roughness), torch.zeros(n), tables).numpy()
            self.photos.append(replace(blank, colour=encode(linear)))

    def fit(self, roughness: float, priors: Priors = FREE) -> MaterialFit:
        n = len(self.texels)
        pairs = neighbours(self.texels, self.normal, self.normal)
        surface = FitSurface(self.texels, self.normal, pairs, self.normal, np.ones(n), np.full((n, 3), 0.3))
        return MaterialFit(surface, 16, priors, roughness)


@pytest.fixture(scope="module")
def glossy() -> Scene:
    return Scene(0.25)


@pytest.fixture(scope="module")
def rendered() -> Scene:
    return Scene(0.25, reference=True)


def test_materials_come_back_from_reference_pictures(rendered: Scene) -> None:
    """Bounds are the worst of three seeds plus a quarter: base colours come back well, roughness comes out as .15 instead of .25."""
    fitted = rendered.fit(0.2).run(rendered.photos[2:], rendered.photos[:2], FitSchedule(300))
    known = fitted.weight > 0.3
    paint, truth = fitted.values[known, :3], rendered.paint[known]
    gain = (paint * truth).sum(0) / (paint**2).sum(0)
    assert np.abs(encode(paint * gain) - encode(truth)).mean() < 0.0095
    assert np.abs(fitted.values[known, 3] - 0.25).mean() < 0.13
    assert fitted.values[known, 4].mean() < 0.04
    assert fitted.held_out is not None and fitted.held_out > 22


def test_a_lamp_is_found_in_reference_pictures(rendered: Scene) -> None:
    """Of what does not glow a tenth is taken for glowing: a highlight that the fit cannot place."""
    lamp, photos = with_lamp(rendered)
    fitted = rendered.fit(0.2).run(photos, [], FitSchedule(300))
    known = fitted.weight > 0.3
    found = fitted.glow.max(1) > 0.1
    assert found[known & lamp].mean() > 0.9 and found[known & ~lamp].mean() < 0.12


def with_lamp(scene: Scene) -> tuple[NDArray[np.bool_], list[Pixels]]:
    """A patch of the ball (texels,) and the scene's photos with that patch of the radiance `LAMP`."""
    lamp = scene.normal @ np.array([0.5, -0.8, 0.33]) > 0.88
    photos = []
    for p in scene.photos:
        share = (p.share * lamp[p.texel]).sum(1, keepdims=True)
        photos.append(replace(p, colour=encode(np.clip((1 - share) * decode(p.colour) + share * LAMP, 0, 1))))
    return lamp, photos


def test_paint_and_roughness_come_back(glossy: Scene) -> None:
    fitted = glossy.fit(0.2).run(glossy.photos[2:], glossy.photos[:2], FitSchedule(300))
    known = fitted.weight > 0.3
    assert known.mean() > 0.4
    paint, truth = fitted.values[known, :3], glossy.paint[known]
    gain = (paint * truth).sum(0) / (paint**2).sum(0)  # brightness is shared with the light
    assert np.abs(encode(paint * gain) - encode(truth)).mean() < 0.06
    assert np.abs(fitted.values[known, 3] - 0.25).mean() < 0.06
    assert fitted.values[known, 4].mean() < 0.1
    assert fitted.held_out is not None and fitted.held_out > 22


def test_an_object_of_metal_alone_keeps_its_light(glossy: Scene) -> None:
    fit = glossy.fit(0.2)
    with torch.no_grad():
        fit._logits[:, 4] = 3.0
    fitted = fit.run(glossy.photos, [], FitSchedule(4, metallic=False, emission=False))
    assert len(fitted.levels) > 0 and all(level.gain == 0 for level in fitted.levels)


def test_a_lamp_on_the_ball_is_told_from_paint(glossy: Scene) -> None:
    lamp, photos = with_lamp(glossy)
    fitted = glossy.fit(0.2).run(photos, [], FitSchedule(300))
    known = fitted.weight > 0.3
    found = fitted.glow.max(1) > 0.1
    assert fitted.glowing == 1
    assert found[known & lamp].mean() > 0.8 and found[known & ~lamp].mean() < 0.03
    np.testing.assert_allclose(np.median(fitted.glow[found & lamp], 0), LAMP, atol=0.1)  # less the gloss of black paint, which it lacks
    assert np.median(fitted.values[found & known, :3]) < 0.05


def test_wrong_normals_bend_towards_what_reflections_show(glossy: Scene) -> None:
    n, truth = len(glossy.texels), glossy.normal
    lean = 0.15 * np.sin(3 * truth[:, 2:]) * np.array([0.3, -0.5, 0.8])
    wrong = (truth + lean) / np.linalg.norm(truth + lean, axis=1, keepdims=True)
    pairs = neighbours(glossy.texels, truth, wrong)
    surface = FitSurface(glossy.texels, truth, pairs, wrong, np.ones(n), np.full((n, 3), 0.3))
    fit = MaterialFit(surface, 16, FREE, 0.2)
    fitted = fit.run(glossy.photos, [], FitSchedule(300))
    known = fitted.weight > 0.3
    bent = wrong + fitted.bend
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    error = [np.arccos(np.clip((x * truth).sum(1), -1, 1))[known].mean() for x in (wrong, bent)]
    assert error[1] < 0.97 * error[0]  # coarse photos of a rather rough ball tell little; without bends the error would stay


def test_trials_tell_smooth_from_rough(glossy: Scene) -> None:
    smooth = trial_roughness(glossy.fit, glossy.photos, 0)
    scene = Scene(0.85)
    matt = trial_roughness(scene.fit, scene.photos, 0)
    assert max(smooth, key=lambda k: smooth[k]) == 0.2
    assert max(matt, key=lambda k: matt[k]) == 0.8
    assert trial_roughness(glossy.fit, glossy.photos[: TRIAL_PHOTO - 1], 0) == {}


def test_same_seed_same_result_and_dark_prior_darkens(glossy: Scene) -> None:
    first, again = (glossy.fit(0.2).run(glossy.photos, [], FitSchedule(30, 3)) for _ in range(2))
    assert np.array_equal(first.values, again.values)
    assert first.held_out is None
    darker = glossy.fit(0.2, Priors(smooth=0.01, dark=0.3)).run(glossy.photos, [], FitSchedule(30, 3))
    assert darker.values[:, :3].mean() < 0.9 * first.values[:, :3].mean()


def test_no_photo_leaves_the_start(glossy: Scene) -> None:
    fitted = glossy.fit(0.4).run([], [], FitSchedule(10))
    assert np.allclose(fitted.values[:, 3], 0.4, atol=1e-6)
    assert fitted.weight.max() == 0


def test_pixels_read_the_texture_where_the_ray_meets_it() -> None:
    mesh, uv = ball()
    texels = rasterise(uv, mesh.faces, 256)
    at = texels.interpolate(np.asarray(mesh.vertices), mesh.faces)
    camera = cameras(1, 64)[0]
    mask = np.zeros((64, 64), np.uint8)
    mask[:, :40] = 255
    pixels = PixelReader(RayCaster(mesh.vertices, mesh.faces, 1), uv, texels, 2.0).read(camera, np.zeros((64, 64, 3), np.uint8), mask)
    point = np.einsum("nk,nkc->nc", pixels.share, at[pixels.texel])
    seen, _ = camera.project(point)
    assert len(pixels) > 500
    # The texture's points project back onto pixel centres, left of the mask's border.
    assert np.abs(seen - np.floor(seen) - 0.5).max() < 0.1
    assert seen[:, 0].max() < 39.5
    assert np.allclose(pixels.towards, (camera.centre - point) / np.linalg.norm(camera.centre - point, axis=1, keepdims=True), atol=0.01)
    assert np.allclose(pixels.share.sum(1), 1)
    assert len(pixels.thinned(100)) <= 100


def test_samples_lie_inside_their_pixels() -> None:
    mesh, uv = ball()
    texels = rasterise(uv, mesh.faces, 512)
    at = texels.interpolate(np.asarray(mesh.vertices), mesh.faces)
    camera = cameras(1, 120)[0]
    reader = PixelReader(RayCaster(mesh.vertices, mesh.faces, 1), uv, texels, 2.0)
    pixel = reader.read(camera, np.zeros((120, 120, 3), np.uint8), None).pixel
    texel, counts = reader.samples(camera, pixel)
    assert texel.shape == counts.shape == (len(pixel), len(SAMPLES)) and counts.mean() > 0.9
    for k, (dx, dy) in enumerate(SAMPLES):
        seen, _ = camera.project(at[texel[:, k]])
        expected = np.stack([pixel % 120, pixel // 120], 1) + 0.5 + (dx, dy)
        assert np.abs(seen - expected)[counts[:, k]].max() < 0.5  # half a texel, which is up to a pixel where the ball is seen frontally


def test_gain_is_divided_out_of_linear_colour() -> None:
    pixels = Pixels(np.zeros((1, 4), np.int64), np.full((1, 4), 0.25, np.float32), np.ones((1, 3), np.float32),
                    encode(np.array([[0.4, 0.2, 0.1]])), np.ones(1, np.float32), np.zeros(1, np.int32), np.zeros(1, np.int64))  # fmt: skip
    assert decode(pixels.without_gain(np.array([2.0, 1.0, 0.5])).colour) == pytest.approx(np.array([[0.2, 0.2, 0.2]]), abs=1e-5)


def test_coarse_texture_keeps_means_and_detail() -> None:
    mesh, uv = ball()
    fine = rasterise(uv, mesh.faces, 256)
    coarse = Coarse.of(uv, mesh.faces, fine, edge=0.01, pixel=0.03)
    assert coarse.texels.size == 64 and coarse.edge == pytest.approx(0.04)
    assert Coarse.of(uv, mesh.faces, fine, edge=0.01, pixel=0.012).same
    at = fine.interpolate(np.asarray(mesh.vertices), mesh.faces)
    smooth = 0.5 + 0.3 * at
    assert np.abs(coarse.up(coarse.down(smooth)) - smooth).mean() < 0.01
    stripes = smooth * np.where(np.arange(len(fine)) % 2, 1.2, 0.8)[:, None]
    restored = coarse.up(coarse.down(stripes)) * coarse.detail(stripes)
    assert np.abs(restored - stripes).mean() < 0.01
