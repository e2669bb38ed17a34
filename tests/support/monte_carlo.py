"""A reference renderer: direct light of a distant environment on convex surfaces by Monte Carlo, in NumPy.

It shares no code with `gsbake.shading`: the BRDF of glTF 2.0 (appendix B: Lambert, GGX with the height-correlated Smith term; Schlick's
Fresnel for metals, Fresnel's equations for dielectrics) is sampled half by the cosine and half by GGX's half vectors, combined by the
balance heuristic (Veach & Guibas, *Optimally combining sampling techniques*, SIGGRAPH 1995). Nothing is prefiltered, no sum is split.
Diffuse reflection gets what the specular layer of a dielectric lets through, one minus its directional albedo, and light is scattered
between microfacets (Kulla & Conty, *Revisiting physically based shading at Imageworks*, 2017).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tests.support.directional_albedo import MEAN_DIELECTRIC, fresnel_of_dielectric, mean_bright, scattered_again, single_scattering

Doubles = NDArray[np.float64]

#: Unit directions (m, 3) to radiance (m, 3).
Environment = Callable[[Doubles], Doubles]


def render(
    normal: Doubles,
    view: Doubles,
    albedo: Doubles,
    roughness: Doubles,
    metallic: Doubles,
    environment: Environment,
    samples: int = 256,
    seed: int = 0,
) -> Doubles:
    """Linear radiance (n, 3) of n unoccluded points: unit `normal`, `view` towards the camera, linear `albedo` (n, 3), the rest (n,)."""
    draw = np.random.default_rng(seed)
    n = len(normal)
    view, alpha = np.asarray(view, float), np.maximum(np.asarray(roughness, float), 0.05) ** 2
    tangent, across = frames(normal)
    nv = np.maximum((normal * view).sum(1), 1e-3)
    specular, diffuse, reflected = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    mean, bright = _bright_albedo(nv, roughness)
    again_metal = scattered_again(mean[:, None], bright[:, None], albedo + (1 - albedo) / 21)  # mean of Schlick's term over the hemisphere
    again = scattered_again(mean, bright, MEAN_DIELECTRIC)
    for k in range(samples):
        u, turn = (k + draw.random(n)) / samples, 2 * np.pi * draw.random(n)
        if k % 2:
            cosine = np.sqrt(1 - u)
            light = local(tangent, across, normal, cosine, turn)
        else:
            half = local(tangent, across, normal, np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u)), turn)
            light = 2 * (half * view).sum(1)[:, None] * half - view
        nl = (normal * light).sum(1)
        up = nl > 1e-6
        middle = light + view
        middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
        nh, vh = np.clip((normal * middle).sum(1), 1e-6, 1), np.clip((view * middle).sum(1), 1e-6, 1)
        distribution = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
        safe = np.maximum(nl, 1e-6)
        smith = safe * np.sqrt(nv**2 * (1 - alpha**2) + alpha**2) + nv * np.sqrt(safe**2 * (1 - alpha**2) + alpha**2)
        dielectric = again * fresnel_of_dielectric(vh)
        conductor = again_metal * (albedo + (1 - albedo) * ((1 - vh) ** 5)[:, None])
        fresnel = metallic[:, None] * conductor + ((1 - metallic) * dielectric)[:, None]
        density = 0.5 * safe / np.pi + 0.5 * distribution * nh / (4 * vh)
        share, lobe = np.where(up, safe / density / samples, 0.0), distribution * 0.5 / smith
        incident = share[:, None] * environment(light)
        specular += lobe[:, None] * fresnel * incident
        diffuse += (1 - metallic[:, None]) * albedo / np.pi * incident
        reflected += share * lobe * dielectric
    return np.asarray(specular + (1 - reflected)[:, None] * diffuse)


def _bright_albedo(nv: Doubles, roughness: Doubles) -> tuple[Doubles, Doubles]:
    """Albedos of lobes with a Fresnel term of 1: the mean over the hemisphere (n,), and that at n·v (n,); n·v and roughness to .05."""
    rounded = np.round(np.maximum(np.stack([nv, roughness], 1), 0.05) * 20) / 20
    key, inverse = np.unique(rounded, axis=0, return_inverse=True)
    bright = np.array([sum(single_scattering(float(c), float(r))[:2]) for c, r in key])[inverse.ravel()]
    mean = np.array([mean_bright(float(r)) for _, r in key])[inverse.ravel()]
    return mean, bright


def local(tangent: Doubles, across: Doubles, normal: Doubles, cosine: Doubles, turn: Doubles) -> Doubles:
    """Unit directions (n, 3) at `cosine` (n,) from the normals, at azimuth `turn` (n,)."""
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    return np.asarray((sine * np.cos(turn))[:, None] * tangent + (sine * np.sin(turn))[:, None] * across + cosine[:, None] * normal)


def frames(normal: Doubles) -> tuple[Doubles, Doubles]:
    """Two unit vectors (n, 3) each, perpendicular to the unit normals (n, 3) and to each other."""
    axis = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0.0, 1.0, 0]])
    tangent = np.cross(axis, normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normal, tangent)
