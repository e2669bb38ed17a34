"""The reference renderer: BRDF against a NumPy transcription of the formulas, energy, shadows, radiometric quantities."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import default_rng

from gsbake.synth import scene
from gsbake.synth.shade import SAMPLE_SUBSETS, brdf_cosine, make_light_rig, outgoing_radiance
from tests.support.directional_albedo import fresnel_of_dielectric

OX, OY, _ = scene.ORIGIN
SIDE = (OX - 0.40, OY, 0.60)  # on the jar, opposite the handle: its whole hemisphere is free
OUT = (-1.0, 0.0, 0.0)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def textbook(
    light: np.ndarray, n: np.ndarray, v: np.ndarray, albedo: np.ndarray, roughness: float, metallic: float, transmitted: float
) -> np.ndarray:
    """D G F / (4 nl nv) with G from the two Smith lambdas, plus attenuated Lambert; times nl."""
    h = unit(light + v)
    nl, nv, nh, vh = n @ light, n @ v, n @ h, v @ h
    a = roughness**2
    tan2 = (1 - nh**2) / nh**2
    d = 1 / (np.pi * a**2 * nh**4 * (1 + tan2 / a**2) ** 2)
    lam = [0.5 * (np.sqrt(1 + a**2 * (1 - c**2) / c**2) - 1) for c in (nl, nv)]
    g = 1 / (1 + lam[0] + lam[1])
    f = metallic * (albedo + (1 - albedo) * (1 - vh) ** 5) + (1 - metallic) * fresnel_of_dielectric(vh)
    return nl * (d * g * f / (4 * nl * nv) + transmitted * (1 - metallic) * albedo / np.pi)


def test_brdf_matches_the_textbook() -> None:
    draw = default_rng(0)
    for _ in range(50):
        n, light, v = (unit(draw.normal(size=3)) for _ in range(3))
        light, v = light * np.sign(n @ light), v * np.sign(n @ v)
        albedo, roughness, metallic = draw.random(3), draw.uniform(0.2, 1), draw.random()
        transmitted = draw.uniform(0.5, 1)
        got = brdf_cosine(tuple(light), tuple(n), tuple(v), (*albedo, roughness, metallic), transmitted)
        np.testing.assert_allclose(got, textbook(light, n, v, albedo, roughness, metallic, transmitted), rtol=1e-9)


def mean_radiance(
    point: tuple[float, ...], n: tuple[float, ...], v: tuple[float, ...], surface: tuple[float, ...], rig: object
) -> np.ndarray:
    """Full quadrature: the mean over all sample subsets."""
    return np.mean([outgoing_radiance(point, n, v, surface, rig, k) for k in range(SAMPLE_SUBSETS)], axis=0)


def test_white_furnace() -> None:
    rig = make_light_rig(ambient=(1, 1, 1))
    v = tuple(unit(np.array([-1.0, 0.3, 0.4])))
    mirror = mean_radiance(SIDE, OUT, v, (1.0, 1.0, 1.0, 0.3, 1.0), rig)
    rough = mean_radiance(SIDE, OUT, v, (1.0, 1.0, 1.0, 0.9, 1.0), rig)
    assert np.all(mirror <= 1 + 1e-6) and mirror.min() > 0.95  # nearly nothing is lost at low roughness
    np.testing.assert_allclose(rough, 0.436, rtol=0.03)  # reflectance of single scattering, by 100 000 uniform directions
    # A black dielectric reflects only its Fresnel part: at least F0 times what white metal keeps, far from 1.
    black = mean_radiance(SIDE, OUT, v, (0.0, 0.0, 0.0, 0.3, 0.0), rig)
    assert 0.035 < black.min() < 0.08
    # What a dielectric's specular layer does not reflect reaches the diffuse one: white loses nothing.
    white = mean_radiance(SIDE, OUT, v, (1.0, 1.0, 1.0, 0.3, 0.0), rig)
    np.testing.assert_allclose(white, 1, rtol=1e-9)


def transmitted(point: tuple[float, ...], n: tuple[float, ...], v: tuple[float, ...], roughness: float) -> np.ndarray:
    """Share of diffuse reflection that a dielectric's specular layer lets through, by a white furnace."""
    return 1 - mean_radiance(point, n, v, (0.0, 0.0, 0.0, roughness, 0.0), make_light_rig(ambient=(1, 1, 1)))


def test_environment_specular_matches_monte_carlo() -> None:
    rig = make_light_rig(ambient=(0.5, 0.5, 0.5), gradient=(0.4, 0.0, -0.3))
    v = unit(np.array([-1.0, -0.2, 0.8]))
    surface = (0.8, 0.6, 0.3, 0.45, 1.0)
    draw = default_rng(1)
    lights = unit(draw.normal(size=(40_000, 3)))
    lights *= np.sign(-lights[:, :1])  # the hemisphere about (-1, 0, 0)
    light_in = np.array([0.5, 0.5, 0.5]) + lights[:, 2:] * np.array([0.4, 0.0, -0.3])
    values = np.array([brdf_cosine(tuple(d), OUT, tuple(v), surface, 1.0) for d in lights])
    expected = 2 * np.pi * np.mean(values * light_in, axis=0)
    np.testing.assert_allclose(mean_radiance(SIDE, OUT, tuple(v), surface, rig), expected, rtol=0.03)


def test_lambert_values() -> None:
    v = (-1.0, 0.0, 0.0)
    direction = unit(np.array([-0.6, 0.0, 0.8]))
    sun = make_light_rig(sun=(np.pi, np.pi, np.pi), sun_direction=tuple(direction))
    rough, black = (0.5, 0.5, 0.5, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0, 0.0)
    diffuse = mean_radiance(SIDE, OUT, v, rough, sun) - mean_radiance(SIDE, OUT, v, black, sun)
    np.testing.assert_allclose(diffuse, 0.5 * 0.6 * transmitted(SIDE, OUT, v, 1.0), rtol=1e-9)  # albedo cos(theta) E / pi
    sky = make_light_rig(ambient=(1, 1, 1), gradient=(0.3, 0.3, 0.3))
    top_rim = (OX + 0.36, OY, 0.92)
    n = (0.0, 0.0, 1.0)
    diffuse = mean_radiance(top_rim, n, n, rough, sky) - mean_radiance(top_rim, n, n, black, sky)
    np.testing.assert_allclose(diffuse, 0.5 * (1 + 2 / 3 * 0.3) * transmitted(top_rim, n, n, 1.0), rtol=1e-9)  # albedo (a + 2/3 b n_z)


def test_area_light_has_its_form_factor() -> None:
    # Irradiance of a whole polygon by Lambert's contour formula: E = L/2 sum_i theta_i (gamma_i . n).
    rig = make_light_rig(area=(1, 1, 1))
    centre = rig.area_points.mean(axis=0)
    u = unit(np.cross(rig.area_normal, [0, 0, 1.0]))
    v = np.cross(rig.area_normal, u)
    point = np.array([OX, OY - 0.40, 0.60])
    n = np.array([0.0, -1.0, 0.0])
    corners = unit(np.array([centre + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]) - point)
    total = 0.0
    for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        total += np.arccos(p @ q) * (unit(np.cross(p, q)) @ n)
    out = tuple(n)
    bright, black = (mean_radiance(tuple(point), out, out, (a, a, a, 1.0, 0.0), rig) for a in (0.8, 0.0))
    diffuse = bright - black
    np.testing.assert_allclose(diffuse, 0.8 / np.pi * abs(total) / 2 * transmitted(tuple(point), out, out, 1.0), rtol=0.01)


@pytest.mark.parametrize(("sun", "lit"), [((0.0, 0.0, 1.0), True), ((1.0, 0.0, 0.05), False)])
def test_shadow_in_the_bowl(sun: tuple[float, float, float], lit: bool) -> None:
    rig = make_light_rig(sun=(1, 1, 1), sun_direction=sun)
    bottom, up = (OX, OY, 0.74), (0.0, 0.0, 1.0)
    got = mean_radiance(bottom, up, up, (0.5, 0.5, 0.5, 0.75, 0.0), rig)
    assert bool(got[0] > 0.1) == lit


def test_bowl_is_partly_occluded() -> None:
    # From its deepest point the bowl's wall hides a share of the sky; the outer wall sees all of it.
    rig = make_light_rig(ambient=(1, 1, 1))
    surface = (0.6, 0.6, 0.6, 0.8, 0.0)
    up = (0.0, 0.0, 1.0)
    inside = mean_radiance((OX, OY, 0.74), up, up, surface, rig)[0]
    free = mean_radiance(SIDE, OUT, OUT, surface, rig)[0]
    assert 0.6 * free < inside < 0.95 * free
