"""The material fit on images of a sphere: base colour, roughness and light are recovered.

Most images are made by the shading model that the fit inverts, which tests the fit alone; with `reference` they come from a Monte Carlo
renderer that shares no code with it, which tests the model too.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from gsbake.materials.descent import Steps, descend
from gsbake.materials.levels import FineLevel, PureMetals
from gsbake.materials.passes import Priors, Scene
from gsbake.materials.photo import Photo, PhotoReader, coarse_texels, texel_weight
from gsbake.materials.recipe import COARSE, START
from gsbake.materials.searches import LightInterval
from gsbake.materials.starts import ChosenStart, Start, StartComparison, Trials, descend_all, started
from gsbake.materials.state import Finer, Level, State
from gsbake.materials.surface import InterpolatedTransport, Materials, Surface, neighbours
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
SCENE = Scene(WEAK_PRIORS, 400, 16)
#: All searches and normals in one run of gradient steps, and the same without searches.
ALL = replace(COARSE, normals=True)
PLAIN = Steps(1.0, normals=True)


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


def rounds(count: int, size: int = 48) -> list[Camera]:
    """Of a turntable: two heights of a camera that stands."""
    out = []
    for k in range(count):
        turn, high = 2.4 * k, (0.5, -0.25)[k % 2]
        centre = 4 * np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        out.append(look_at(centre, size=size, focal=1.7 * size, name=f"{k}"))
    return out


def room(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance of dim walls with one window and a small bright light."""
    window = np.exp(12 * (directions @ np.array([0.8, 0.0, 0.6]) - 1))
    lamp = np.exp(60 * (directions @ np.array([-0.6, 0.8, 0.0]) - 1))
    return (0.25 + 4 * window + 12 * lamp)[:, None] * np.ones(3)


class Sphere:
    """A sphere of two base colours, or of a uniform distribution between them (`even`), with constant `roughness`, in `count` photos.

    With `reference` the images are made by `tests.support.monte_carlo`; `motion` is that of the light, which shows before cameras that are
    `posed` in rounds. With `striped` only the second base
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
        posed: Sequence[Camera] = (),
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
        reader = PhotoReader(caster, uv, self.texels, self.normal, 2.0)
        self.photos: list[Photo] = []
        self.posed = posed or cameras(count)
        turned = light_rotations(self.posed, motion)
        for k, camera in enumerate(self.posed):
            if turned is not None:
                tables = EnvironmentLight.from_function(lambda d, turn=turned[k]: room(d @ turn.T), 16).prefilter()
            blank = reader.read(camera, np.zeros((camera.height, camera.width, 3), np.uint8), None, index=k)
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

    def surface(self) -> Surface:
        n = len(self.texels)
        pairs = neighbours(self.texels, self.normal, self.normal)
        return Surface(self.texels, self.normal, pairs, self.normal, np.ones(n), np.full((n, 3), 0.3))

    def start(self, roughness: float, photos: list[Photo] | None = None, held_out: int = 0, metallic: float = 0.05) -> State:
        """A start from the `photos`, of which the first `held_out` are for validation."""
        every = self.photos if photos is None else photos
        return State.start(Level(self.surface(), every[held_out:], every[:held_out]), 16, roughness, metallic)


def after(state: State, steps: int, plan: Steps = ALL, priors: Priors = WEAK_PRIORS, seed: int = 0, diffuse: bool = False) -> State:
    """The state after gradient steps."""
    return descend(Scene(priors, 400, 16, seed, diffuse), state, plan, skip, steps).judged()


def skip(done: int, total: int) -> None:
    """Do nothing after a step."""


def observed(state: State) -> NDArray[np.bool_]:
    """Which texels (n,) the photos show."""
    return texel_weight(state.level.photos, len(state.values)) > 0.3


@pytest.fixture(scope="module")
def glossy() -> Sphere:
    return Sphere(0.25)


@pytest.fixture(scope="module")
def rendered() -> Sphere:
    return Sphere(0.25, reference=True)


def test_materials_are_recovered_from_reference_images(rendered: Sphere) -> None:
    """Bounds are the worst of three seeds plus a quarter; roughness comes out as .15 instead of .25."""
    fitted = after(rendered.start(0.2, held_out=2), 300)
    known = observed(fitted)
    base_color, truth = fitted.materials.base_color[known], rendered.base_color[known]
    gain = (base_color * truth).sum(0) / (base_color**2).sum(0)
    assert np.abs(encode(base_color * gain) - encode(truth)).mean() < 0.014
    assert np.abs(fitted.materials.roughness[known] - 0.25).mean() < 0.13
    assert fitted.materials.metallic[known].mean() < 0.04
    assert fitted.psnr is not None and fitted.psnr > 22


def test_emission_is_detected_in_reference_images(rendered: Sphere) -> None:
    """A tenth of the other texels is detected too: a highlight that the fit cannot explain."""
    patch, photos = with_emission(rendered)
    fitted = after(rendered.start(0.2, photos), 300)
    known = observed(fitted)
    found = fitted.transport["emission"].max(1) > 0.1
    assert found[known & patch].mean() > 0.9 and found[known & ~patch].mean() < 0.12


def with_emission(scene: Sphere) -> tuple[NDArray[np.bool_], list[Photo]]:
    """A patch of the sphere (texels,) and the scene's photos with that patch emitting `EMISSION`."""
    patch = scene.normal @ np.array([0.5, -0.8, 0.33]) > 0.88
    photos = []
    for p in scene.photos:
        share = (p.bilinear * patch[p.texel]).sum(1, keepdims=True)
        photos.append(replace(p, colour=encode(np.clip((1 - share) * decode(p.colour) + share * EMISSION, 0, 1))))
    return patch, photos


def test_base_colour_and_roughness_are_recovered(glossy: Sphere) -> None:
    fitted = after(glossy.start(0.2, held_out=2), 300)
    known = observed(fitted)
    assert known.mean() > 0.4
    base_color, truth = fitted.materials.base_color[known], glossy.base_color[known]
    gain = (base_color * truth).sum(0) / (base_color**2).sum(0)  # brightness is shared with the light
    assert np.abs(encode(base_color * gain) - encode(truth)).mean() < 0.06
    assert np.abs(fitted.materials.roughness[known] - 0.25).mean() < 0.08
    assert fitted.materials.metallic[known].mean() < 0.1
    assert fitted.psnr is not None and fitted.psnr > 22


def test_all_metal_object_has_no_light_adjustment(glossy: Sphere) -> None:
    fitted = after(glossy.start(0.2, metallic=0.9), 4, Steps(1.0, passes=COARSE.passes[1:2]))
    assert len(fitted.adjustments) > 0 and all(adjustment.improvement == 0 for adjustment in fitted.adjustments)


@pytest.mark.parametrize("metallic", [0.05, 0.9])
def test_the_open_factors_follow_the_light(glossy: Sphere, metallic: float) -> None:
    """Under a light 1.5 times as bright, on base colours as much darker, they are divided by as much: of photos and of the prior alone."""
    state, scene = after(glossy.start(0.2, metallic=metallic), 40), Scene(WEAK_PRIORS, 400, 16)
    m, light = state.materials, EnvironmentLight.from_radiance(1.5 * state.radiance)
    every = np.arange(len(m))
    bright = state.with_light(light).with_inside(every, Materials(m.base_color / 1.5, m.roughness, m.metallic)).with_transport()
    before, after_it = (LightInterval().run(scene, one).open_factors for one in (state, bright))
    assert before is not None and after_it is not None and before[0] < before[1] < 4
    assert after_it == pytest.approx(np.array(before) / 1.5, rel=0.08)


def test_emission_is_separated_from_base_colour(glossy: Sphere) -> None:
    patch, photos = with_emission(glossy)
    fitted = after(glossy.start(0.2, photos), 300)
    known = observed(fitted)
    found = fitted.transport["emission"].max(1) > 0.1
    assert fitted.emissive_regions == 1
    assert found[known & patch].mean() > 0.8 and found[known & ~patch].mean() < 0.03
    # Less the specular reflection of a black dielectric, which the patch does not have.
    np.testing.assert_allclose(np.median(fitted.transport["emission"][found & patch], 0), EMISSION, atol=0.1)
    assert np.median(fitted.materials.base_color[found & known]) < 0.05


@pytest.mark.slow
def test_normal_offsets_reduce_normal_error(glossy: Sphere) -> None:
    n, truth = len(glossy.texels), glossy.normal
    tilt = 0.15 * np.sin(3 * truth[:, 2:]) * np.array([0.3, -0.5, 0.8])
    wrong = (truth + tilt) / np.linalg.norm(truth + tilt, axis=1, keepdims=True)
    pairs = neighbours(glossy.texels, truth, wrong)
    surface = Surface(glossy.texels, truth, pairs, wrong, np.ones(n), np.full((n, 3), 0.3))
    fitted = after(State.start(Level(surface, [p.with_normals(wrong) for p in glossy.photos], []), 16, 0.2), 300)
    known, offset = observed(fitted), fitted.materials.normal_offset
    assert offset is not None
    refined = wrong + offset
    refined /= np.linalg.norm(refined, axis=1, keepdims=True)
    error = [np.arccos(np.clip((x * truth).sum(1), -1, 1))[known].mean() for x in (wrong, refined)]
    assert error[1] < 0.97 * error[0]  # low-resolution photos of a rather rough sphere are weak evidence


def trial_errors(scene: Sphere) -> dict[tuple[float, float], float]:
    starts = StartComparison(START).starts
    trials = descend_all(started(SCENE, scene.start(0.2, held_out=2).level, starts), START, SCENE, "trials")
    return {start: state.error for start, state in trials.items()}


@pytest.mark.slow
def test_trials_find_the_roughness(glossy: Sphere) -> None:
    smooth, rough = trial_errors(glossy), trial_errors(Sphere(0.85))
    dielectric = StartComparison(START).dielectric_starts
    assert min(dielectric, key=lambda k: smooth[k]) == (0.05, 0.25)
    assert min(dielectric, key=lambda k: rough[k]) == (0.05, 0.8)


@pytest.mark.slow
def test_metal_is_found_from_the_best_start() -> None:
    """A sphere of two metals, in reference images: from the start that the trials choose, nearly all texels end as metal (median of five
    orders of the photos)."""
    scene = Sphere(0.25, reference=True, metallic=1.0)
    errors = trial_errors(scene)
    metallic, roughness = min(errors, key=lambda start: errors[start])
    shares = []
    for seed in range(5):
        fitted = after(scene.start(roughness, held_out=2, metallic=metallic), 200, seed=seed)
        shares.append(fitted.metal[observed(fitted)].mean())
    assert np.median(shares) > 0.9
    dielectric = after(scene.start(0.2, held_out=2), 200, replace(ALL, passes=COARSE.passes[:2]))
    assert fitted.psnr is not None and dielectric.psnr is not None
    assert fitted.psnr > dielectric.psnr + 1


def test_purified_metals_have_a_median_of_one(glossy: Sphere) -> None:
    before = glossy.start(0.3, metallic=0.7)
    pure = PureMetals().run(SCENE, before)
    assert np.median(pure.materials.metallic) == pytest.approx(0.99, abs=1e-3)
    np.testing.assert_allclose(pure.values[:, :4], before.values[:, :4], atol=1e-6)
    np.testing.assert_array_equal(PureMetals().run(SCENE, glossy.start(0.3)).values, glossy.start(0.3).values)


def test_the_fine_level_continues_from_the_coarse_one(glossy: Sphere) -> None:
    fine = glossy.surface()
    _, uv = sphere()
    texture = CoarseTexture.sized(uv, sphere()[0].faces, glossy.texels, 1.0, SIZE // 2)
    coarse = fine.coarse(texture)
    photos = [p.on_coarse_texels(texture, coarse.normal) for p in glossy.photos]
    assert sum(map(len, photos)) == pytest.approx(sum(map(len, glossy.photos)) / 4, rel=0.02)
    parent = coarse_texels(texture)
    known = parent >= 0
    distance = np.linalg.norm(coarse.position[parent[known]] - fine.position[known], axis=1)
    assert known.mean() > 0.9 and distance.max() < 0.2  # texels are about 0.1 wide
    finer = Finer(Level(fine, glossy.photos[2:], glossy.photos[:2]), texture)
    fitted = after(State.start(Level(coarse, photos[2:], photos[:2], finer), 16, 0.2), 150, PLAIN)
    continued = after(FineLevel().run(SCENE, fitted), 1, replace(PLAIN, rate=1e-6))
    np.testing.assert_allclose(np.median(continued.values, 0), np.median(fitted.values, 0), atol=0.03)
    scratch = after(glossy.start(0.2, held_out=2), 1, replace(PLAIN, rate=1e-6))
    assert continued.psnr is not None and scratch.psnr is not None
    assert continued.psnr > scratch.psnr + 3


def test_the_fit_starts_anew_from_the_start_that_was_chosen_on_a_coarser_level(glossy: Sphere) -> None:
    fine = glossy.start(0.2).level
    tried = replace(after(glossy.start(0.7), 3, PLAIN), chosen_start=(0.05, 0.2), evidence="less error")
    found = ChosenStart().run(SCENE, replace(tried, level=replace(fine, finer=Finer(fine, tried_texture(glossy)))))
    assert found.level is fine and found.steps == 0 and (found.chosen_start, found.evidence) == ((0.05, 0.2), "less error")
    np.testing.assert_allclose(found.values[:, 3], 0.2)


def tried_texture(scene: Sphere) -> CoarseTexture:
    """Half the edge of the scene's texture."""
    return CoarseTexture.sized(sphere()[1], sphere()[0].faces, scene.texels, 1.0, SIZE // 2)


def test_coarse_transport_is_interpolated(glossy: Sphere) -> None:
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


def test_fit_is_deterministic_and_base_colour_prior_darkens(glossy: Sphere) -> None:
    start = glossy.start(0.2)
    before = start.values.copy()
    first, again = (after(start, 30, seed=3) for _ in range(2))
    assert np.array_equal(first.values, again.values) and np.array_equal(start.values, before)
    assert first.psnr is None
    darker = after(start, 30, priors=Priors.of(Bake(smoothness=0.01, base_color_l1=0.3)), seed=3)
    assert darker.materials.base_color.mean() < 0.9 * first.materials.base_color.mean()


def test_momentum_of_the_light_goes_on_until_another_light(glossy: Sphere) -> None:
    fitted = after(glossy.start(0.2), 3, PLAIN)
    again = after(fitted, 2, PLAIN)
    assert fitted.light_moments is not None and again.light_moments is not None
    assert [float(state[2]) for state in (fitted.light_moments, again.light_moments)] == [3, 5]
    assert fitted.with_light(fitted.light).light_moments is None


def test_a_light_that_stands_steps_for_several_photos_together(glossy: Sphere) -> None:
    start, together = glossy.start(0.2), replace(PLAIN, photos_per_light=2)
    moments = after(start, 5, together).light_moments
    assert moments is not None and moments[2] == 2
    assert not np.array_equal(after(start, 2, together).radiance, start.radiance)
    np.testing.assert_array_equal(after(start, 1, together).radiance, start.radiance)
    level = replace(start.level, photos=[replace(photo, to_light=np.eye(3)) for photo in start.level.photos])
    moments = after(replace(start, level=level), 5, together).light_moments
    assert moments is not None and moments[2] == 5


def test_a_light_that_is_given_stays(glossy: Sphere) -> None:
    start = glossy.start(0.2)
    fitted = after(replace(start, light_given=True), 3, PLAIN)
    assert np.array_equal(fitted.radiance, start.radiance) and not np.array_equal(fitted.values, start.values)
    assert not np.array_equal(after(start, 3, PLAIN).radiance, start.radiance)


def test_without_photos_nothing_changes(glossy: Sphere) -> None:
    fitted = after(glossy.start(0.4, []), 10)
    assert np.allclose(fitted.materials.roughness, 0.4, atol=1e-6)
    assert not observed(fitted).any()


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
    scene, comparison = Sphere(roughness, reference=True, metallic=metallic), StartComparison(START)

    def tried(level: Level, starts: Sequence[Start]) -> Trials:
        return descend_all(started(SCENE, level, starts), START, SCENE, "trials")

    starts, _ = comparison.compared(scene.start(0.2).level, False, tried)
    assert starts in ([(start,) for start in comparison.metal_starts] if metallic else [(comparison.default_start,)])
