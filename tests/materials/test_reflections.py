"""Reflections of the object on itself: the texel hit, and that they do not end up in base colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gsbake.config.schema import Bake
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import encode
from gsbake.materials.fit_kernel import TRANSPORT
from gsbake.materials.passes import Priors
from gsbake.materials.photo import Photo, PhotoReader
from gsbake.materials.recipe import COARSE
from gsbake.materials.state import Level, State
from gsbake.materials.surface import Surface, neighbours
from gsbake.materials.visibility import Visibility
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.reflection_kernel import specular_visibility
from gsbake.shading.split_sum import shade
from gsbake.texturing.texels import rasterise
from tests.materials.reference import Transport, reflected_radiance
from tests.materials.test_fit import after, observed
from tests.support.cameras import look_at
from tests.support.split_sum import transmitted_share

Doubles = NDArray[np.float64]
SIZE = 64


class Corner:
    """A floor 2 × 2 at z = 0 and a wall 1 high on its edge y = 0, each with half of the texture, in photos from above."""

    def __init__(self) -> None:
        self.vertices = np.array([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 1], [1, 0, 1]], float)
        self.uv = np.array([[0.02, 0.02], [0.48, 0.02], [0.48, 0.98], [0.02, 0.98], [0.52, 0.02], [0.98, 0.02], [0.98, 0.98], [0.52, 0.98]])
        self.faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
        self.texels = rasterise(self.uv, self.faces, SIZE)
        self.at = self.texels.interpolate(self.vertices, self.faces).astype(np.float64)
        self.floor = self.texels.face < 2
        self.normal = np.where(self.floor[:, None], [0.0, 0, 1], [0.0, 1, 0])
        self.caster = RayCaster(self.vertices, self.faces, 1)

    def read(self, k: int, traced: bool) -> Photo:
        """The pixels of photo `k` of 16, black."""
        turn, high = np.pi / 2 + 1.1 * np.sin(2.4 * k), 0.3 + 0.7 * k / 16
        away = np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        target = np.array([0, 0.7, 0.3])
        camera = look_at(target + 4 * away, target, size=64, focal=110)
        reader = PhotoReader(self.caster, self.uv, self.texels, self.normal, 3.0)
        photo = reader.read(camera, np.zeros((64, 64, 3), np.uint8), None)
        return reader.with_reflections(photo, self.at, 1e-3) if traced else photo

    def mirrored(self, pixels: Photo) -> tuple[NDArray[np.bool_], Doubles, Doubles]:
        """Which pixels show mostly floor, where they are, and where the mirrored view meets the plane of the wall: by hand."""
        at = np.einsum("nk,nkd->nd", pixels.bilinear, self.at[pixels.texel])
        floor = np.einsum("nk,nk->n", pixels.bilinear, self.floor[pixels.texel]) > 0.99
        ray = pixels.view * [-1, -1, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where(ray[:, 1] < 0, -at[:, 1] / ray[:, 1], np.inf)
        return floor, at, at + far[:, None].clip(0, 100) * ray


@pytest.fixture(scope="module")
def corner() -> Corner:
    return Corner()


@pytest.mark.parametrize("k", [0, 5, 11])
def test_reflected_ray_hits_the_expected_texel(corner: Corner, k: int) -> None:
    pixels = corner.read(k, traced=True)
    assert len(pixels.reflected) == len(pixels)
    floor, _, there = corner.mirrored(pixels)
    inside = floor & (np.abs(there[:, 0]) < 0.95) & (there[:, 2] < 0.95)
    outside = floor & ((np.abs(there[:, 0]) > 1.05) | (there[:, 2] > 1.05))
    assert inside.sum() > 30 and outside.sum() > 30
    assert (pixels.reflected[outside] == -1).all()
    met = pixels.reflected[inside]
    assert (met >= 0).mean() > 0.97  # next to the wall a ray may start behind it
    met, there = met[met >= 0], there[inside][met >= 0]
    assert (~corner.floor[met]).all()
    assert np.linalg.norm(corner.at[met] - there, axis=1).max() < 0.08  # a texel is .065 wide


def test_untraced_pixels_have_no_reflected_texel(corner: Corner) -> None:
    assert len(corner.read(0, traced=False).reflected) == 0
    few = corner.read(0, traced=True).every(10)
    assert 0 < len(few.reflected) == len(few)


def test_reflection_does_not_change_base_colour(corner: Corner) -> None:
    """Both lit by an even sky; the floor, smooth and nearly black, shows the wall's orange by the law of reflection."""
    light = EnvironmentLight.from_function(lambda d: np.ones((len(d), 3)), 16)
    tables, n = light.prefilter(), len(corner.texels)
    base_color = np.where(corner.floor[:, None], [0.02, 0.02, 0.02], [0.9, 0.4, 0.05])
    visibility = Visibility.trace(corner.texels, corner.uv, corner.caster, corner.normal, 128, 1e-3, 0.1)
    white = light.radiance().detach().numpy()
    visible_share = visibility.visible_share(white)
    irradiance = visible_share[:, None] * np.ones((1, 3), np.float32)
    irradiance = irradiance + visibility.indirect_irradiance(irradiance, base_color.astype(np.float32))

    def photo(k: int, traced: bool) -> Photo:
        pixels = corner.read(k, traced)
        floor, _, there = corner.mirrored(pixels)
        blocked = floor & (np.abs(there[:, 0]) < 1) & (there[:, 2] < 1)
        normal, diffuse, spread = (
            torch.as_tensor(np.einsum("nk,nkc->nc", pixels.bilinear, x[pixels.texel])).float()
            for x in (corner.normal, base_color * irradiance, irradiance)
        )
        view, m = torch.as_tensor(pixels.view), len(pixels)
        specular = shade(normal, view, torch.zeros(m, 3), torch.full((m,), 0.1), torch.zeros(m), tables).detach()
        wall = torch.tensor([0.9, 0.4, 0.05]) * 0.96 * spread.mean() + 0.04  # seen near its normal; its layer reflects the sky
        specular = torch.where(torch.as_tensor(blocked)[:, None], specular * wall, specular)
        diffuse = diffuse * transmitted_share(normal, view, torch.full((m,), 0.1))[:, None]
        # A light that is said to move, here by nothing, has no prior of its radiance: the sky's is 1, and the prior expects .7.
        return replace(pixels, colour=encode((diffuse + specular).numpy()).astype(np.float32), to_light=np.eye(3))

    def error(traced: bool) -> float:
        pairs = neighbours(corner.texels, corner.at, corner.normal)
        start = np.full((n, 3), 0.3)
        surface = Surface(corner.texels, corner.at, pairs, corner.normal, visible_share, start, visibility)
        level = Level(surface, [photo(k, traced) for k in range(16)], [])
        plan = replace(COARSE, normals=True, passes=COARSE.passes[1:2])  # the light
        fitted = after(State.start(level, 8, 0.2), 120, plan, Priors.of(Bake()))
        known = corner.floor & observed(fitted) & (corner.at[:, 1] < 0.8)
        return float(np.abs(encode(fitted.materials.base_color[known]) - encode(base_color[known])).mean())

    assert error(True) < 0.7 * error(False)


def test_a_reflected_mirror_shows_the_light_behind_the_viewer() -> None:
    """A ray that comes down onto a mirror at 45° leaves along +x: it carries F0 times the light from there, and what the texel emits."""
    light = EnvironmentLight.from_function(lambda at: np.repeat(np.where(at[:, :1] > 0.5, 2.0, 0.1), 3, 1), 32).prefilter().detach()
    met = np.zeros(1, TRANSPORT)
    met["occlusion"], met["emission"], met["roughness"], met["metallic"] = 1, [0, 0, 0.5], 0.1, 1
    met["metal_colour"], met["normal"] = [0.9, 0.6, 0.3], [np.sqrt(0.5), 0, np.sqrt(0.5)]
    found = reflected_radiance(Transport.of(met), torch.tensor([[0.0, 0, -1]]), light)[0]
    fresnel = (1 - np.sqrt(0.5)) ** 5
    expected = [2 * (f0 + (1 - f0) * fresnel) + emitted for f0, emitted in ((0.9, 0), (0.6, 0), (0.3, 0.5))]
    assert found.tolist() == pytest.approx(expected, rel=0.03)


def test_smooth_lobe_goes_by_its_mirror_direction_and_a_rough_one_by_the_ambient_share() -> None:
    """Half of the hemisphere is blocked; the reflected ray of the first pixel is blocked, that of the second is not."""
    cosine, half, reflected, none = np.float32(0.8), np.float32(0.5), np.array([7, -1], np.int32), np.zeros(0, np.int32)
    smooth, rough = np.float32(0.02), np.float32(1)
    visible, around, incident, texel = specular_visibility(cosine, smooth, half, reflected, 0)
    assert [visible, around, incident, texel] == pytest.approx([0, 0, 1, 7], abs=1e-3)
    visible, around, incident, _ = specular_visibility(cosine, smooth, half, reflected, 1)
    assert [visible, around, incident] == pytest.approx([1, 0, 0], abs=1e-3)
    for pixels, i in ((reflected, 0), (reflected, 1), (none, 0)):
        visible, around, incident, _ = specular_visibility(cosine, rough, half, pixels, i)
        assert [visible, incident] == pytest.approx([0.5, 0], abs=1e-3)
        assert around == pytest.approx(1, abs=2e-3)  # of the indirect irradiance, which half of the hemisphere sends
