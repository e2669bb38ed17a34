"""Renderer against closed forms: projection, coverage, texture sampling, normal maps, shading, filtering."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsbake.geometry.cameras import Camera
from gsbake.imaging.sampling import bilinear
from gsbake.imaging.srgb import decode, encode
from gsbake.report.lights import PROCEDURAL_LIGHTS, LitShader, procedural
from gsbake.report.render import Asset, Renderer, unlit
from gsbake.shading.environment import EnvironmentLight
from tests.report.shapes import ball, front_camera, quad
from tests.support.split_sum import transmitted_share


def test_srgb_known_values() -> None:
    np.testing.assert_allclose(encode(np.array([0.0, 0.001, 0.18, 0.5, 1.0])), [0, 0.01292, 0.461356, 0.735357, 1], atol=1e-5)
    codes = np.linspace(0, 1, 256)
    np.testing.assert_allclose(encode(decode(codes)), codes, atol=1e-5)


def test_bilinear_centres_midpoints_and_wrap() -> None:
    image = np.arange(8, dtype=np.float32).reshape(2, 4, 1)
    uv = np.array([[0.125, 0.25], [0.375, 0.75], [0.25, 0.25], [0.125, 0.5], [0.0, 0.25], [1.125, 0.25]], np.float32)
    np.testing.assert_allclose(bilinear(image, uv)[:, 0], [0, 5, 0.5, 2, 1.5, 0], atol=1e-6)


def test_texture_coordinates() -> None:
    base = np.zeros((2, 2, 3))
    base[0, 0], base[0, 1], base[1, 0], base[1, 1] = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)
    # Distance 4, focal 60: the square covers 2 · 60 / 4 = 30 of 40 pixels.
    picture = Renderer(quad(base)).draw(front_camera(4, 40, 60), unlit, samples=1)
    assert picture.alpha.sum() == 900
    assert picture.alpha[5:35, 5:35].min() == 1
    # Texel centres are at u = 1/4 and 3/4: pixel 5 + 7 has its centre at u = 7.5 / 30. v = 0 is the top row of texture and image.
    np.testing.assert_allclose(picture.rgb[12, 12], [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(picture.rgb[12, 27], [0, 1, 0], atol=1e-3)
    np.testing.assert_allclose(picture.rgb[27, 12], [0, 0, 1], atol=1e-3)
    np.testing.assert_allclose(picture.normal[20, 20], [0, 0, 1], atol=1e-6)


def test_sphere_covers_the_area_of_its_cone() -> None:
    picture = Renderer(ball(1.0)).draw(front_camera(4, 128, 180), unlit, samples=3)
    radius = 180 / math.sqrt(4**2 - 1)  # a sphere of radius r at distance d on the axis: f r / √(d² − r²)
    assert picture.alpha.sum() == pytest.approx(math.pi * radius**2, rel=2e-3)
    ys, xs = np.mgrid[:128, :128] + 0.5
    inside = np.hypot(xs - 64, ys - 64) < radius - 2
    assert picture.alpha[inside].min() == 1
    np.testing.assert_allclose(picture.rgb[inside], encode(np.array(0.5)), atol=1e-4)
    # The normal at a pixel is the first intersection of its ray with the unit sphere.
    ray = np.array([(80.5 - 64) / 180, -(50.5 - 64) / 180, -1.0])
    a, b, c = ray @ ray, 2 * ray[2] * 4, 15.0
    hit = np.array([0, 0, 4.0]) + ray * (-b - math.sqrt(b * b - 4 * a * c)) / (2 * a)
    np.testing.assert_allclose(picture.normal[50, 80], hit, atol=5e-3)


def test_edges_are_averaged_in_linear_radiance() -> None:
    base = np.zeros((2, 2, 3))
    base[:, 0] = 1.0
    sharp = np.repeat(np.repeat(base, 64, 0), 64, 1)  # left half white, right half black
    camera = front_camera(4, 41, 60)  # odd: the edge runs through the centre of column 20
    picture = Renderer(quad(sharp)).draw(camera, unlit, samples=4)
    np.testing.assert_allclose(picture.rgb[20, 20], encode(np.array(0.5)), atol=0.03)


def linear_light(a: float, b: tuple[float, float, float]) -> EnvironmentLight:
    return EnvironmentLight.from_function(lambda d: np.repeat(a + d @ np.array(b)[:, None], 3, axis=1), size=16)


def diffuse(asset_of: object, shader: LitShader) -> np.ndarray:
    """Mean linear radiance at the centre minus that of the same asset in black: the diffuse part."""
    out = []
    for grey in (0.6, 0.0):
        picture = Renderer(asset_of(grey)).draw(front_camera(4, 32, 40), shader)  # type: ignore[operator]
        out.append(decode(picture.rgb[12:20, 12:20]).mean((0, 1)))
    return out[0] - out[1]


ROUGH = np.broadcast_to(np.float32([1, 1, 0]), (4, 4, 3)).copy()


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (-0.4, 0.3)])
def test_normal_map_in_tangent_space(tilt: tuple[float, float]) -> None:
    # Radiance a + b·d has irradiance π (a + 2/3 b·n), which determines the normal. +X of the map is the tangent, +Y up in the image.
    n = np.array([*tilt, math.sqrt(1 - tilt[0] ** 2 - tilt[1] ** 2)])
    local_normal = np.broadcast_to(n.astype(np.float32), (4, 4, 3)).copy()
    b = (0.2, 0.25, 0.1)
    got = diffuse(
        lambda grey: quad(np.full((4, 4, 3), grey), orm=ROUGH, normal_map=local_normal),
        LitShader(linear_light(0.5, b)),
    )
    np.testing.assert_allclose(got, 0.6 * (0.5 + 2 / 3 * n @ np.array(b)), rtol=0.02)


def test_mirrored_tangent_frame() -> None:
    local_normal = np.broadcast_to(np.float32([0, 0.6, 0.8]), (4, 4, 3)).copy()

    def mirrored(grey: float) -> Asset:
        plain = quad(np.full((4, 4, 3), grey), orm=ROUGH, normal_map=local_normal)
        tangent = np.tile(np.float32([1, 0, 0, -1]), (4, 1))
        return Asset(plain.position, plain.normal, tangent, plain.uv, plain.faces, plain.base_color, plain.orm, plain.normal_map)

    got = diffuse(mirrored, LitShader(linear_light(0.5, (0, 0.3, 0))))
    tilted, view = torch.tensor([[0.0, 0.6, 0.8]]), torch.tensor([[0.0, 0.0, 1.0]])
    through = float(transmitted_share(tilted, view, torch.ones(1)))
    np.testing.assert_allclose(got, 0.6 * (0.5 - 2 / 3 * 0.6 * 0.3) * through, rtol=0.02)


def test_light_frame_and_occlusion() -> None:
    # The environment is brightest along its +X; the rotation maps the asset's +Z, the normal of the square, to it.
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    light = linear_light(0.5, (0.3, 0, 0))
    got = diffuse(lambda grey: quad(np.full((4, 4, 3), grey), orm=ROUGH), LitShader(light, turn))
    np.testing.assert_allclose(got, 0.6 * (0.5 + 2 / 3 * 0.3), rtol=0.02)
    half = ROUGH * np.float32([0.5, 1, 1])
    got = diffuse(lambda grey: quad(np.full((4, 4, 3), grey), orm=half), LitShader(light, turn))
    np.testing.assert_allclose(got, 0.3 * (0.5 + 2 / 3 * 0.3), rtol=0.02)


def test_emission_is_added_to_reflected_radiance() -> None:
    emission = np.full((4, 4, 3), (0.0, 0.1, 0.3), np.float32)
    for strength, base in ((0.0, 0.0), (1.0, 0.25)):
        shown = Renderer(quad(np.full((4, 4, 3), base), emissive=strength * emission)).draw(front_camera(4, 40, 60), unlit, samples=1)
        np.testing.assert_allclose(decode(shown.rgb[20, 20]), base + strength * emission[0, 0], atol=1e-4)


def test_equirectangular_map_is_in_the_asset_frame() -> None:
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    image = LitShader(linear_light(0.5, (0.3, 0, 0)), turn).equirectangular(32)
    # three.js: u = atan2(z, x) / 2π + ½, so the asset's +Z lies at three quarters of the width, −Z at one quarter.
    np.testing.assert_allclose(image[15:17, 48].mean(0), 0.8, atol=0.02)
    np.testing.assert_allclose(image[15:17, 16].mean(0), 0.2, atol=0.02)


def test_minified_textures_do_not_alias() -> None:
    checker = (np.indices((512, 512)).sum(0) % 2).astype(np.float32)[..., None].repeat(3, 2)
    picture = Renderer(quad(checker)).draw(front_camera(4, 40, 60), unlit, samples=1)
    np.testing.assert_allclose(decode(picture.rgb[6:34, 6:34]), 0.5, atol=0.01)


def test_screen_bounds_at_the_border_and_inside() -> None:
    renderer = Renderer(ball(1.0))
    whole = renderer.draw(front_camera(4, 64, 90), unlit)
    camera = front_camera(4, 64, 90)
    shifted = Camera("s", 64, 64, 90, 90, camera.cx + 20, camera.cy - 20, camera.R, camera.t)
    part = renderer.draw(shifted, unlit)
    np.testing.assert_array_equal(part.alpha[:44, 20:], whole.alpha[20:, :44])
    away = Camera("a", 64, 64, 90, 90, 500, 32, camera.R, camera.t)
    assert renderer.draw(away, unlit).alpha.max() == 0
    assert renderer.draw(front_camera(0, 16, 8), unlit).alpha.min() == 1  # camera inside the ball
    behind = Camera("b", 64, 64, 90, 90, 32, 32, np.eye(3), np.array([0, 0, -4.0]))
    assert renderer.draw(behind, unlit).alpha.max() == 0


def test_over_grey() -> None:
    picture = Renderer(quad(np.ones((2, 2, 3)))).draw(front_camera(4, 40, 60), unlit, samples=1)
    over = picture.over(0.25)
    np.testing.assert_allclose(over[0, 0], 0.25)
    np.testing.assert_allclose(over[20, 20], 1, atol=1e-5)


@pytest.mark.parametrize("name", sorted(PROCEDURAL_LIGHTS))
def test_procedural_environments_are_finite_and_well_exposed(name: str) -> None:
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radiance = PROCEDURAL_LIGHTS[name](directions)
    assert radiance.shape == (20_000, 3) and radiance.min() >= 0 and np.isfinite(radiance).all()
    # Irradiance / π of normals to the front and up: neither too dark nor overexposed.
    for n in ((0, 0, 1.0), (0, 1.0, 0)):
        irradiance = 4 * np.mean(radiance.mean(1) * np.clip(directions @ np.array(n), 0, None))
        assert 0.25 < irradiance < 1.5
    assert procedural(name).light.size == 32
