"""Visibility and indirect light against closed forms and an independent path tracer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from gsbake.config.schema import Bake
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.srgb import encode
from gsbake.materials.passes import Priors
from gsbake.materials.photo import Photo, PhotoReader
from gsbake.materials.recipe import COARSE
from gsbake.materials.state import Level, State
from gsbake.materials.surface import Surface, neighbours
from gsbake.materials.visibility import ROTATIONS, Visibility, directions, unoccluded_irradiance
from gsbake.shading import cubemap
from gsbake.shading.environment import EnvironmentLight
from gsbake.texturing.texels import Texels, rasterise
from tests.materials.test_fit import after, observed
from tests.support.cameras import look_at
from tests.support.monte_carlo import render
from tests.support.split_sum import transmitted_share

Doubles = NDArray[np.float64]
WHITE = EnvironmentLight.from_function(lambda d: np.ones((len(d), 3)), 16).radiance().detach().numpy()


class Quads:
    """Rectangles (corner, edge, edge) facing along edge × edge, each with its own cell of the texture; `extra` meshes only occlude."""

    def __init__(
        self, *quads: tuple[list[float], list[float], list[float]], extra: trimesh.Trimesh | None = None, count: int = 256
    ) -> None:
        size, across = 64, int(np.ceil(np.sqrt(len(quads))))
        points, uv, faces = [], [], []
        for k, quad in enumerate(quads):
            o, a, b = (np.array(x, float) for x in quad)
            points += [o, o + a, o + a + b, o + b]
            cell = np.array([k % across, k // across])
            uv += [(cell + x) / across for x in ([0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9])]
            faces += [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]]
        vertices, coordinates, triangles = np.array(points), np.array(uv), np.array(faces)
        self.texels: Texels = rasterise(coordinates, triangles, size)
        self.at = self.texels.interpolate(vertices, triangles).astype(np.float64)
        corner = vertices[triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        self.normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[self.texels.face]
        self.quad = self.texels.face // 2
        if extra is not None:
            triangles = np.concatenate([triangles, extra.faces + len(vertices)])
            coordinates = np.concatenate([coordinates, np.zeros((len(extra.vertices), 2))])
            vertices = np.concatenate([vertices, extra.vertices])
        self.uv, self.caster = coordinates, RayCaster(vertices, triangles, 1)
        self.visibility = Visibility.trace(self.texels, coordinates, self.caster, self.normal, count, offset=1e-4, radius=0.1)


def perpendicular(beside: Doubles, high: float, away: Doubles) -> Doubles:
    """Share of the hemisphere that a rectangle `beside` × `high` takes, `away` from its foot at one end (Howell's catalogue, B-4)."""
    slant = np.sqrt(high**2 + away**2)
    return np.asarray((np.arctan(beside / away) - away / slant * np.arctan(beside / slant)) / (2 * np.pi))


@pytest.fixture(scope="module")
def corner() -> Quads:
    """A floor 2 × 2 and a wall 1 high along its edge y = 0."""
    return Quads(([0, 0, 0], [2, 0, 0], [0, 2, 0]), ([2, 0, 0], [-2, 0, 0], [0, 0, 1]))


def test_occlusion_of_uniform_light_is_the_form_factor(corner: Quads) -> None:
    floor = (corner.quad == 0) & (corner.at[:, 1] > 0.15)
    x, y = corner.at[floor, 0].clip(1e-3, 2 - 1e-3), corner.at[floor, 1]
    taken = perpendicular(x, 1.0, y) + perpendicular(2 - x, 1.0, y)
    blocked = 1 - corner.visibility.visible_share(WHITE)[floor]
    assert taken.max() > 0.35
    assert np.abs(blocked - taken).max() < 0.03
    assert blocked.mean() == pytest.approx(taken.mean(), abs=0.004)


def test_indirect_light_follows_the_form_factor(corner: Quads) -> None:
    floor = (corner.quad == 0) & (corner.at[:, 1] > 0.15)
    x, y = corner.at[floor, 0].clip(1e-3, 2 - 1e-3), corner.at[floor, 1]
    taken = perpendicular(x, 1.0, y) + perpendicular(2 - x, 1.0, y)
    wall = (corner.quad == 1)[:, None]
    gained = corner.visibility.indirect_irradiance(np.tile([2.0, 1.0, 0.5], (len(wall), 1)), np.where(wall, [0.8, 0.4, 0.2], 0.0))
    assert np.abs(gained[floor] - taken[:, None] * [1.6, 0.4, 0.1]).max() < 0.05
    assert gained[wall[:, 0]].max() == 0  # the floor is black


def test_closed_box_has_two_bounces() -> None:
    """Every ray inside meets a wall: 1 becomes ρ at the first and ρ + ρ² at the second bounce, whatever the shape."""
    box = Quads(
        ([0, 0, 0], [1, 0, 0], [0, 1, 0]), ([0, 0, 2], [0, 1, 0], [1, 0, 0]), ([0, 0, 0], [0, 1, 0], [0, 0, 2]),
        ([1, 0, 0], [0, 0, 2], [0, 1, 0]), ([0, 0, 0], [0, 0, 2], [1, 0, 0]), ([0, 1, 0], [1, 0, 0], [0, 0, 2]),
    )  # fmt: skip
    assert box.visibility.visible_share(WHITE).max() < 1e-6
    ones = np.ones((len(box.texels), 3))
    gained = box.visibility.indirect_irradiance(ones, 0.5 * ones)
    assert np.median(gained) == pytest.approx(0.75, abs=0.02)
    assert np.abs(gained - 0.75).max() < 0.06


def test_directional_light_casts_shadow_on_the_far_side_only() -> None:
    thin = trimesh.creation.box((0.02, 4, 0.5), trimesh.transformations.translation_matrix([0, 0, 0.25]))
    scene = Quads(([-1, -1, 0], [2, 0, 0], [0, 2, 0]), extra=thin)
    direction = np.array([1, 0, 1]) / np.sqrt(2)
    light = EnvironmentLight.from_function(lambda d: (1e-3 + 50 * np.exp(400 * (d @ direction - 1)))[:, None] * np.ones(3), 32)
    visible_share = scene.visibility.visible_share(light.radiance().detach().numpy())
    x = scene.at[:, 0]
    # At 45° a wall of height .5 shades the floor up to .5 behind it; cells of the directions are some 7° in radius.
    assert visible_share[x > 0.1].min() > 0.97
    assert visible_share[(x > -0.3) & (x < -0.1)].max() < 0.1
    assert visible_share[x < -0.8].min() > 0.9


def test_shadow_of_a_sphere_agrees_with_path_tracing() -> None:
    centre, radius = np.array([0.1, -0.1, 0.8]), 0.5
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    ball.apply_translation(centre)
    scene = Quads(([-1, -1, 0], [2, 0, 0], [0, 2, 0]), extra=ball)

    def sky(d: Doubles) -> Doubles:
        return (0.2 + np.maximum(0, d @ np.array([0.6, 0.0, 0.8])) ** 8)[:, None] * np.array([1.0, 0.5, 0.2])

    light = EnvironmentLight.from_function(sky, 32)
    visible_share = scene.visibility.visible_share(light.radiance().detach().numpy())
    rng = np.random.default_rng(2)
    ray = rng.normal(size=(4000, 3))
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) + [0, 0, 1]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    value = sky(ray)[:, 0]
    some = np.arange(0, len(scene.texels), 37)
    out = []
    for point in scene.at[some]:
        along = ray @ (centre - point)
        blocked = (along > 0) & (((centre - point) ** 2).sum() - along**2 < radius**2)
        out.append((value * ~blocked).sum() / value.sum())
    truth = np.array(out)
    assert truth.min() < 0.5 and truth.max() > 0.9
    assert np.sqrt(((visible_share[some] - truth) ** 2).mean()) < 0.03
    assert np.abs(visible_share[some] - truth).max() < 0.1


def test_open_surface_is_unoccluded() -> None:
    scene = Quads(([-1, -1, 0], [2, 0, 0], [0, 2, 0]), count=32)
    assert scene.visibility.visible_share(WHITE).min() == 1
    ones = np.ones((len(scene.texels), 3))
    assert scene.visibility.indirect_irradiance(ones, ones).max() == 0


def test_every_copy_of_directions_is_uniform() -> None:
    copies = directions(128).astype(np.float64)
    assert np.allclose(np.linalg.norm(copies, axis=2), 1, atol=1e-6)
    assert np.abs(copies.mean(1)).max() < 0.01
    second = np.einsum("tni,tnj->tij", copies, copies) / 128
    assert np.abs(second - np.eye(3) / 3).max() < 0.01
    assert len({tuple(x) for x in copies[:, 0].round(4)}) == len(copies)


class Tray:
    """An open box of two base colours under light from one side, its irradiance path-traced with random rays, in 12 photos."""

    def __init__(self) -> None:
        self.box = Quads(
            ([-1, -1, 0], [2, 0, 0], [0, 2, 0]), ([-1, -1, 0], [0, 2, 0], [0, 0, 1]), ([1, -1, 0], [0, 0, 1], [0, 2, 0]),
            ([-1, -1, 0], [0, 0, 1], [2, 0, 0]), ([-1, 1, 0], [2, 0, 0], [0, 0, 1]), ([1.1, -1.1, -0.1], [0, 2.2, 0], [0, 0, 1.1]),
            ([-1.1, -1.1, -0.1], [0, 0, 1.1], [0, 2.2, 0]), ([-1.1, 1.1, -0.1], [0, 0, 1.1], [2.2, 0, 0]),
            ([-1.1, -1.1, -0.1], [2.2, 0, 0], [0, 0, 1.1]), count=128,
        )  # fmt: skip
        texels, at, normal = self.box.texels, self.box.at, self.box.normal
        direction = np.array([0.55, 0.3, 0.78])
        light = EnvironmentLight.from_function(lambda d: (0.3 + 10 * np.exp(40 * (d @ direction - 1)))[:, None] * np.ones(3), 32)
        cube = light.radiance().detach().numpy().reshape(-1, 3)
        stripe = np.sin(6 * at[:, 0] + 3 * at[:, 2]) * np.sin(5 * at[:, 1] - 4 * at[:, 2]) > 0
        self.base_color = np.where(stripe[:, None], [0.75, 0.35, 0.2], [0.35, 0.6, 0.7])
        slot = np.full(texels.size**2, -1)
        slot[texels.index] = np.arange(len(texels))
        rng, rounds = np.random.default_rng(4), 200
        direct, links = np.zeros((len(texels), 3)), []
        for _ in range(rounds):
            ray = rng.normal(size=(len(texels), 3))
            ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) + normal
            hits = self.box.caster.first_hit(at + 1e-4 * normal, ray)
            direct[~hits.hit] += cube[cubemap.texel_index(32, ray[~hits.hit])] / rounds
            faces, bary = self.box.caster.faces[hits.face[hits.hit]], hits.bary[hits.hit]
            column, row = (np.einsum("nk,nkd->nd", bary, self.box.uv[faces]) * texels.size).astype(int).T
            links.append((np.flatnonzero(hits.hit), slot[row * texels.size + column]))
        irradiance = direct
        for _ in range(4):
            gained = np.zeros_like(direct)
            for start, met in links:
                gained[start] += self.base_color[met] * irradiance[met] / rounds
            irradiance = direct + gained
        self.inside, self.cube, self.slot, self.diffuse = self.box.quad < 5, cube, slot, self.base_color * irradiance
        reader = PhotoReader(self.box.caster, self.box.uv, texels, normal, 4.0)
        self.photos = [self.photo(reader, k) for k in range(12)]

    def incident(self, point: Doubles, ray: Doubles) -> Doubles:
        """Radiance (n, 3) that arrives at points (n, 3) along rays (n, 3): of the sky, or of what the box reflects diffusely."""
        hits = self.box.caster.first_hit(point, ray)
        faces, bary = self.box.caster.faces[hits.face[hits.hit]], hits.bary[hits.hit]
        column, row = (np.einsum("nk,nkd->nd", bary, self.box.uv[faces]) * self.box.texels.size).astype(int).T
        radiance = np.asarray(self.cube[cubemap.texel_index(32, ray)], np.float64)
        radiance[hits.hit] = self.diffuse[self.slot[row * self.box.texels.size + column]]
        return radiance

    def photo(self, reader: PhotoReader, k: int) -> Photo:
        turn, high = 2.4 * k, 0.3 + 1.1 * k / 12
        centre = 5 * np.array([np.cos(turn) * np.cos(high), np.sin(turn) * np.cos(high), np.sin(high)])
        blank = reader.read(look_at(centre, size=64, focal=100), np.zeros((64, 64, 3), np.uint8), None)
        colour, normal, point = (
            np.einsum("nk,nkc->nc", blank.bilinear, x[blank.texel])
            for x in (self.diffuse, self.box.normal, self.box.at + 1e-4 * self.box.normal)
        )
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        n, view = len(blank), blank.view.astype(np.float64)
        rough = np.full(n, 0.5)
        specular = render(normal, view, np.zeros((n, 3)), rough, np.zeros(n), lambda ray: self.incident(point, ray), 64, k)
        lets_through = transmitted_share(*(torch.as_tensor(x).float() for x in (normal, view, rough)))
        return replace(blank, colour=encode(colour * lets_through.numpy()[:, None] + specular))

    def error(self, visibility: Visibility | None, indirect: bool, sparsity: float = 0.0) -> float:
        """Mean error of the base colour (sRGB) inside the box fitted under the true light, up to a gain."""
        priors = replace(Priors.of(Bake()), sparsity=sparsity)
        texels = self.box.texels
        ambient = np.ones(len(texels)) if visibility is None else visibility.visible_share(WHITE)
        start = np.full((len(texels), 3), 0.4)
        pairs = neighbours(texels, self.box.at, self.box.normal)
        surface = Surface(texels, self.box.at, pairs, self.box.normal, ambient, start, visibility, indirect)
        light = EnvironmentLight.from_radiance(self.cube.reshape(6, 32, 32, 3))
        state = State.start(Level(surface, self.photos, []), 32, 0.5).with_light(light).with_transport()
        passes = (COARSE.passes[0], COARSE.passes[2])  # emission and metals
        fitted = after(replace(state, light_given=True), 300, replace(COARSE, normals=True, passes=passes), priors)
        known = observed(fitted)
        base = fitted.materials.base_color
        gain = (base[known] * self.base_color[known]).sum(0) / (base[known] ** 2).sum(0)
        known &= self.inside
        return float(np.abs(encode(base[known] * gain) - encode(self.base_color[known])).mean())


def test_shadows_and_indirect_light_stay_out_of_base_colour() -> None:
    tray = Tray()
    visibility = tray.box.visibility
    none, direct, indirect = tray.error(None, False), tray.error(visibility, False), tray.error(visibility, True)
    assert direct < 0.9 * none
    assert indirect < 0.95 * direct
    assert tray.error(visibility, True, Priors.of(Bake()).sparsity) < 0.9 * indirect


def test_unoccluded_irradiance_is_the_sum_over_directions() -> None:
    rng, n, count = np.random.default_rng(3), 70, 12
    normal = rng.normal(size=(n, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rotation, cells = rng.integers(ROTATIONS, size=n), rng.uniform(size=(ROTATIONS, count)).astype(np.float32)
    found = np.empty(n, np.float32)
    unoccluded_irradiance(normal, rotation, directions(count), cells, found)
    cosine = np.maximum(np.einsum("nc,nkc->nk", normal.astype(float), directions(count)[rotation].astype(float)), 0)
    assert np.allclose(found, (cosine * cells[rotation]).sum(1) * 4 / count, atol=1e-5)
