"""The material fit on images of a sphere: base colour, roughness and light are recovered.

Most images are made by the shading model that the fit inverts, which tests the fit alone; with `reference` they come from a Monte Carlo
renderer that shares no code with it, which tests the model too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from gsbake.config.schema import Bake
from gsbake.geometry.cameras import Camera
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import decode, encode
from gsbake.materials.adjacency import neighbours
from gsbake.materials.fit import MaterialFit
from gsbake.materials.fit_surface import FitSurface
from gsbake.materials.initialisation import DEFAULT_START, METAL_STARTS, STARTS, compared_starts, trial_fits, trial_schedule
from gsbake.materials.levels import FitLevel, InterpolatedTransport, coarse_pixels, coarse_surface, coarse_texels
from gsbake.materials.options import FitSchedule, Priors
from gsbake.materials.pixels import PixelReader, Pixels
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import Motion, light_rotations
from gsbake.shading.split_sum import shade
from gsbake.texturing.resampling import CoarseTexture
from gsbake.texturing.texels import Texels, rasterise
from tests.support.cameras import look_at
from tests.support.monte_carlo import render
from tests.support.slow import slow

SIZE = 64
EMISSION = np.array([0.0, 0.5, 0.9], np.float32)
WEAK_PRIORS = Priors.of(Bake(smoothness=0.01, base_color_l1=0.0))


def sphere() -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
    """An open latitude-longitude sphere of radius 1 with its texture coordinates."""
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
        out.append(look_at(centre, size=size, focal=1.7 * size, name=f"{k}"))
    return out


def room(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance of dim walls with one window and a small bright light."""
    window = np.exp(12 * (directions @ np.array([0.8, 0.0, 0.6]) - 1))
    lamp = np.exp(60 * (directions @ np.array([-0.6, 0.8, 0.0]) - 1))
    return (0.25 + 4 * window + 12 * lamp)[:, None] * np.ones(3)


class Scene:
    """A sphere of two base colours, or of a uniform distribution between them (`even`), with constant `roughness`, in `count` photos.

    With `reference` the images are made by `tests.support.monte_carlo`; `motion` is that of the light. With `striped` only the second base
    colour has the `metallic` given, the first is dielectric: `metallic` (n,) has the true values."""

    def __init__(
        self,
        roughness: float,
        count: int = 12,
        even: bool = False,
        reference: bool = False,
        metallic: float = 0.0,
        motion: Motion = "static",
        striped: bool = False,
    ) -> None:
        mesh, uv = sphere()
        caster = RayCaster(mesh.vertices, mesh.faces, 1)
        self.texels: Texels = rasterise(uv, mesh.faces, SIZE)
        self.normal = self.texels.interpolate(np.asarray(mesh.vertices), mesh.faces)
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        # Stripes: a base colour that followed the normal could be light as well.
        stripe = np.sin(5 * np.arctan2(self.normal[:, 1], self.normal[:, 0]) + 4 * self.normal[:, 2])[:, None]
        share = np.arcsin(stripe) / np.pi + 0.5 if even else stripe > 0
        self.base_color = (share * [0.6, 0.2, 0.1] + (1 - share) * [0.05, 0.3, 0.4]).astype(np.float32)
        self.metallic = np.where(striped & (share[:, 0] > 0.5), 0.0, metallic).astype(np.float32)
        tables = EnvironmentLight.from_function(room, 16).prefilter()
        reader = PixelReader(caster, uv, self.texels, 2.0)
        self.photos: list[Pixels] = []
        turned = light_rotations(cameras(count), motion)
        for k, camera in enumerate(cameras(count)):
            if turned is not None:
                tables = EnvironmentLight.from_function(lambda d, turn=turned[k]: room(d @ turn.T), 16).prefilter()
            blank = reader.read(camera, np.zeros((camera.height, camera.width, 3), np.uint8), None)
            base_color, normal = (np.einsum("nk,nkc->nc", blank.bilinear, x[blank.texel]) for x in (self.base_color, self.normal))
            n, metal = len(blank), np.einsum("nk,nk->n", blank.bilinear, self.metallic[blank.texel])
            if reference:
                unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
                linear = render(unit, blank.view, base_color, np.full(n, roughness), metal, room)
            else:
                with torch.no_grad():
                    n_, base_ = torch.as_tensor(normal, dtype=torch.float32), torch.as_tensor(base_color, dtype=torch.float32)
                    rough_, metal_ = torch.full((n,), roughness), torch.as_tensor(metal, dtype=torch.float32)
                    linear = shade(n_, torch.as_tensor(blank.view), base_, rough_, metal_, tables).numpy()
            self.photos.append(replace(blank, colour=encode(linear)))

    def surface(self) -> FitSurface:
        n = len(self.texels)
        pairs = neighbours(self.texels, self.normal, self.normal)
        return FitSurface(self.texels, self.normal, pairs, self.normal, np.ones(n), np.full((n, 3), 0.3))

    def fit(self, roughness: float, priors: Priors = WEAK_PRIORS, metallic: float = 0.05) -> MaterialFit:
        return MaterialFit(self.surface(), 16, priors, roughness, metallic)


@pytest.fixture(scope="module")
def glossy() -> Scene:
    return Scene(0.25)


@pytest.fixture(scope="module")
def rendered() -> Scene:
    return Scene(0.25, reference=True)


def test_materials_are_recovered_from_reference_images(rendered: Scene) -> None:
    """Bounds are the worst of three seeds plus a quarter; roughness comes out as .15 instead of .25."""
    fitted = rendered.fit(0.2).run(rendered.photos[2:], rendered.photos[:2], FitSchedule(300))
    known = fitted.weight > 0.3
    base_color, truth = fitted.values[known, :3], rendered.base_color[known]
    gain = (base_color * truth).sum(0) / (base_color**2).sum(0)
    assert np.abs(encode(base_color * gain) - encode(truth)).mean() < 0.014
    assert np.abs(fitted.values[known, 3] - 0.25).mean() < 0.13
    assert fitted.values[known, 4].mean() < 0.04
    assert fitted.held_out_psnr is not None and fitted.held_out_psnr > 22


def test_emission_is_detected_in_reference_images(rendered: Scene) -> None:
    """A tenth of the other texels is detected too: a highlight that the fit cannot explain."""
    patch, photos = with_emission(rendered)
    fitted = rendered.fit(0.2).run(photos, [], FitSchedule(300))
    known = fitted.weight > 0.3
    found = fitted.emission.max(1) > 0.1
    assert found[known & patch].mean() > 0.9 and found[known & ~patch].mean() < 0.12


def with_emission(scene: Scene) -> tuple[NDArray[np.bool_], list[Pixels]]:
    """A patch of the sphere (texels,) and the scene's photos with that patch emitting `EMISSION`."""
    patch = scene.normal @ np.array([0.5, -0.8, 0.33]) > 0.88
    photos = []
    for p in scene.photos:
        share = (p.bilinear * patch[p.texel]).sum(1, keepdims=True)
        photos.append(replace(p, colour=encode(np.clip((1 - share) * decode(p.colour) + share * EMISSION, 0, 1))))
    return patch, photos


def test_base_colour_and_roughness_are_recovered(glossy: Scene) -> None:
    fitted = glossy.fit(0.2).run(glossy.photos[2:], glossy.photos[:2], FitSchedule(300))
    known = fitted.weight > 0.3
    assert known.mean() > 0.4
    base_color, truth = fitted.values[known, :3], glossy.base_color[known]
    gain = (base_color * truth).sum(0) / (base_color**2).sum(0)  # brightness is shared with the light
    assert np.abs(encode(base_color * gain) - encode(truth)).mean() < 0.06
    assert np.abs(fitted.values[known, 3] - 0.25).mean() < 0.08
    assert fitted.values[known, 4].mean() < 0.1
    assert fitted.held_out_psnr is not None and fitted.held_out_psnr > 22


def test_all_metal_object_has_no_light_adjustment(glossy: Scene) -> None:
    fitted = glossy.fit(0.2, metallic=0.9).run(glossy.photos, [], FitSchedule(4, metal_searches_at=(), emission=False))
    assert len(fitted.light_adjustments) > 0 and all(adjustment.improvement == 0 for adjustment in fitted.light_adjustments)


def test_emission_is_separated_from_base_colour(glossy: Scene) -> None:
    patch, photos = with_emission(glossy)
    fitted = glossy.fit(0.2).run(photos, [], FitSchedule(300))
    known = fitted.weight > 0.3
    found = fitted.emission.max(1) > 0.1
    assert fitted.emissive_regions == 1
    assert found[known & patch].mean() > 0.8 and found[known & ~patch].mean() < 0.03
    # Less the specular reflection of a black dielectric, which the patch does not have.
    np.testing.assert_allclose(np.median(fitted.emission[found & patch], 0), EMISSION, atol=0.1)
    assert np.median(fitted.values[found & known, :3]) < 0.05


@pytest.mark.slow
def test_normal_offsets_reduce_normal_error(glossy: Scene) -> None:
    n, truth = len(glossy.texels), glossy.normal
    tilt = 0.15 * np.sin(3 * truth[:, 2:]) * np.array([0.3, -0.5, 0.8])
    wrong = (truth + tilt) / np.linalg.norm(truth + tilt, axis=1, keepdims=True)
    pairs = neighbours(glossy.texels, truth, wrong)
    surface = FitSurface(glossy.texels, truth, pairs, wrong, np.ones(n), np.full((n, 3), 0.3))
    fit = MaterialFit(surface, 16, WEAK_PRIORS, 0.2)
    fitted = fit.run(glossy.photos, [], FitSchedule(300))
    known = fitted.weight > 0.3
    refined = wrong + fitted.normal_offset
    refined /= np.linalg.norm(refined, axis=1, keepdims=True)
    error = [np.arccos(np.clip((x * truth).sum(1), -1, 1))[known].mean() for x in (wrong, refined)]
    assert error[1] < 0.97 * error[0]  # low-resolution photos of a rather rough sphere are weak evidence


def trial_errors(scene: Scene) -> dict[tuple[float, float], float]:
    level = FitLevel(scene.surface(), scene.photos[2:], scene.photos[:2])
    trials = trial_fits(lambda m, r: scene.fit(r, metallic=m), level, STARTS, trial_schedule(100, 0, False), skip)
    return {start: fitted.held_out_loss or 0.0 for start, (_, fitted) in trials.items()}


def skip(done: int, total: int) -> None:
    """Do nothing after a step."""


@pytest.mark.slow
def test_trials_find_the_roughness(glossy: Scene) -> None:
    smooth, rough = trial_errors(glossy), trial_errors(Scene(0.85))
    dielectric = [(0.05, r) for r in (0.2, 0.45, 0.8)]
    assert min(dielectric, key=lambda k: smooth[k]) == (0.05, 0.2)
    assert min(dielectric, key=lambda k: rough[k]) == (0.05, 0.8)


@pytest.mark.slow
def test_metal_is_found_from_the_best_start() -> None:
    """A sphere of two metals, in reference images: from the start that the trials choose, nearly all texels end as metal (median of five
    orders of the photos)."""
    scene = Scene(0.25, reference=True, metallic=1.0)
    errors = trial_errors(scene)
    metallic, roughness = min(errors, key=lambda start: errors[start])
    shares = []
    for seed in range(5):
        fitted = scene.fit(roughness, metallic=metallic).run(scene.photos[2:], scene.photos[:2], FitSchedule(200, seed))
        shares.append((fitted.values[fitted.weight > 0.3, 4] > 0.5).mean())
    assert np.median(shares) > 0.9
    dielectric = scene.fit(0.2).run(scene.photos[2:], scene.photos[:2], FitSchedule(200, metal_searches_at=()))
    assert fitted.held_out_psnr is not None and dielectric.held_out_psnr is not None
    assert fitted.held_out_psnr > dielectric.held_out_psnr + 1


def test_purified_metals_have_a_median_of_one(glossy: Scene) -> None:
    fit = glossy.fit(0.3, metallic=0.7)
    before = fit.run(glossy.photos[2:], [], FitSchedule(0)).values
    fit.rescale_metallic()
    after = fit.run(glossy.photos[2:], [], FitSchedule(0)).values
    assert np.median(before[:, 4]) == pytest.approx(0.7, abs=1e-3) and np.median(after[:, 4]) == pytest.approx(0.99, abs=1e-3)
    np.testing.assert_allclose(after[:, :4], before[:, :4], atol=1e-6)
    dielectric = glossy.fit(0.3, metallic=0.05)
    dielectric.rescale_metallic()
    assert dielectric.run(glossy.photos[2:], [], FitSchedule(0)).values[:, 4].max() < 0.1


def test_the_fine_level_continues_from_the_coarse_one(glossy: Scene) -> None:
    fine = glossy.surface()
    _, uv = sphere()
    texture = CoarseTexture.sized(uv, sphere()[0].faces, glossy.texels, 1.0, SIZE // 2)
    coarse = coarse_surface(fine, texture)
    photos = [coarse_pixels(p, texture) for p in glossy.photos]
    assert sum(map(len, photos)) == pytest.approx(sum(map(len, glossy.photos)) / 4, rel=0.02)
    parent = coarse_texels(texture)
    known = parent >= 0
    distance = np.linalg.norm(coarse.position[parent[known]] - fine.position[known], axis=1)
    assert known.mean() > 0.9 and distance.max() < 0.2  # texels are about 0.1 wide
    fit = MaterialFit(coarse, 16, WEAK_PRIORS, 0.2)
    fitted = fit.run(photos[2:], photos[:2], FitSchedule(150, metal_searches_at=(), emission=False, light_searches_at=()))
    briefly = FitSchedule(1, rate=1e-6, light_searches_at=())
    continued = fit.continued_on(fine, texture.up).run(glossy.photos[2:], glossy.photos[:2], briefly)
    np.testing.assert_allclose(np.median(continued.values, 0), np.median(fitted.values, 0), atol=0.03)
    scratch = glossy.fit(0.2).run(glossy.photos[2:], glossy.photos[:2], briefly)
    assert continued.held_out_psnr is not None and scratch.held_out_psnr is not None
    assert continued.held_out_psnr > scratch.held_out_psnr + 3


def test_coarse_transport_is_interpolated(glossy: Scene) -> None:
    """Constant and linear transport arrive unchanged at the fine texels."""
    texture = CoarseTexture.sized(sphere()[1], sphere()[0].faces, glossy.texels, 1.0, SIZE // 2)
    position = texture.texels.interpolate(np.asarray(sphere()[0].vertices), sphere()[0].faces)

    class Linear:
        def visible_share(self, radiance: NDArray[np.float32]) -> NDArray[np.float32]:
            return 0.5 + 0.4 * position[:, 2]

        def indirect_irradiance(self, irradiance: NDArray[np.float32], reflectance: NDArray[np.float32]) -> NDArray[np.float32]:
            return irradiance * reflectance

    transport = InterpolatedTransport(Linear(), texture)
    n = len(glossy.texels)
    at = glossy.texels.interpolate(np.asarray(sphere()[0].vertices), sphere()[0].faces)
    assert np.abs(transport.visible_share(np.zeros((6, 4, 4, 3))) - (0.5 + 0.4 * at[:, 2])).mean() < 0.01
    indirect = transport.indirect_irradiance(np.full((n, 3), 2.0, np.float32), np.full((n, 3), 0.25, np.float32))
    np.testing.assert_allclose(indirect, 0.5, atol=1e-5)


def test_fit_is_deterministic_and_base_colour_prior_darkens(glossy: Scene) -> None:
    first, again = (glossy.fit(0.2).run(glossy.photos, [], FitSchedule(30, 3)) for _ in range(2))
    assert np.array_equal(first.values, again.values)
    assert first.held_out_psnr is None
    darker = glossy.fit(0.2, Priors.of(Bake(smoothness=0.01, base_color_l1=0.3))).run(glossy.photos, [], FitSchedule(30, 3))
    assert darker.values[:, :3].mean() < 0.9 * first.values[:, :3].mean()


def test_without_photos_nothing_changes(glossy: Scene) -> None:
    fitted = glossy.fit(0.4).run([], [], FitSchedule(10))
    assert np.allclose(fitted.values[:, 3], 0.4, atol=1e-6)
    assert fitted.weight.max() == 0


def test_pixels_read_the_texture_at_the_ray_hit() -> None:
    mesh, uv = sphere()
    texels = rasterise(uv, mesh.faces, 256)
    at = texels.interpolate(np.asarray(mesh.vertices), mesh.faces)
    camera = cameras(1, 64)[0]
    mask = np.zeros((64, 64), np.uint8)
    mask[:, :40] = 255
    pixels = PixelReader(RayCaster(mesh.vertices, mesh.faces, 1), uv, texels, 2.0).read(camera, np.zeros((64, 64, 3), np.uint8), mask)
    point = np.einsum("nk,nkc->nc", pixels.bilinear, at[pixels.texel])
    pixel_position, _ = camera.project(point)
    assert len(pixels) > 500
    # Points of the texture project back onto pixel centres, left of the mask's boundary.
    assert np.abs(pixel_position - np.floor(pixel_position) - 0.5).max() < 0.1
    assert pixel_position[:, 0].max() < 39.5
    assert np.allclose(pixels.view, (camera.centre - point) / np.linalg.norm(camera.centre - point, axis=1, keepdims=True), atol=0.01)
    assert np.allclose(pixels.bilinear.sum(1), 1)
    assert len(pixels.subsampled(100)) <= 100


def test_gain_is_divided_out_of_linear_colour() -> None:
    pixels = Pixels(np.zeros((1, 4), np.int64), np.full((1, 4), 0.25, np.float32), np.ones((1, 3), np.float32),
                    encode(np.array([[0.4, 0.2, 0.1]])), np.ones(1, np.float32), np.zeros(1, np.int32), np.zeros(1, np.int64))  # fmt: skip
    assert decode(pixels.without_gain(np.array([2.0, 1.0, 0.5])).colour) == pytest.approx(np.array([[0.2, 0.2, 0.2]]), abs=1e-5)


def test_coarse_texture_preserves_means_and_detail() -> None:
    mesh, uv = sphere()
    fine = rasterise(uv, mesh.faces, 256)
    coarse = CoarseTexture.of(uv, mesh.faces, fine, edge=0.01, pixel=0.03)
    assert coarse.texels.size == 64 and coarse.edge == pytest.approx(0.04)
    assert CoarseTexture.of(uv, mesh.faces, fine, edge=0.01, pixel=0.012).is_fine
    at = fine.interpolate(np.asarray(mesh.vertices), mesh.faces)
    smooth = 0.5 + 0.3 * at
    assert np.abs(coarse.up(coarse.down(smooth)) - smooth).mean() < 0.01
    stripes = smooth * np.where(np.arange(len(fine)) % 2, 1.2, 0.8)[:, None]
    restored = coarse.up(coarse.down(stripes)) * coarse.detail(stripes)
    assert np.abs(restored - stripes).mean() < 0.01


@pytest.mark.parametrize(("roughness", "metallic"), [(0.35, 0.0), slow(0.15, 1.0)])
def test_a_few_photos_tell_a_metal_from_a_dielectric(roughness: float, metallic: float) -> None:
    """The metal is smooth: the search for metals turns a rough one from the dielectric start too, and neither start is clearly better."""
    scene = Scene(roughness, reference=True, metallic=metallic)
    level = FitLevel(scene.surface(), scene.photos, [])
    starts, _ = compared_starts(lambda m, r: scene.fit(r, metallic=m), level, trial_schedule(100, 0, False), skip)
    assert starts in ([(start,) for start in METAL_STARTS] if metallic else [(DEFAULT_START,)])
