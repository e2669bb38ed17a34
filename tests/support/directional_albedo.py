"""Directional albedo of GGX by brute force, single scattering and with light that is scattered between microfacets.

Shares no code with `gsbake.shading`: textbook formulas summed over a grid of half-vectors, and the approximation of Kulla & Conty,
*Revisiting physically based shading at Imageworks*, 2017.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Mean Fresnel reflectance over the hemisphere, cosine-weighted, of a dielectric of index of refraction 1.5 (d'Eon & Irving, 2011).
MEAN_DIELECTRIC = 0.0918
#: Half-vectors that integrals are summed over: the sums differ by 1e-4 from those over 2 000 rings of 720 sectors.
RINGS, SECTORS = 500, 180


def fresnel_of_dielectric(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reflectance at the cosine of incidence, by Snell's law and Fresnel's two polarisations, index of refraction 1.5."""
    outside = np.clip(cosine, 0, 1)
    inside = np.sqrt(1 - (1 - outside**2) / 1.5**2)
    across = (outside - 1.5 * inside) / (outside + 1.5 * inside)
    along = (1.5 * outside - inside) / (1.5 * outside + inside)
    return np.asarray(0.5 * (across**2 + along**2))


@lru_cache(maxsize=4096)
def single_scattering(cosine: float, roughness: float) -> tuple[float, float, float]:
    """∫ (n·l) D G2 / (4 n·l n·v) {1−Fc, Fc, F} dl on a grid over half-vectors, dl = 4 (v·h) dh; no importance sampling, textbook formulas:
    Fc is Schlick's term, F a dielectric's reflectance by the two polarisations."""
    alpha = roughness**2
    # t = tan θ_h on a stretched grid, so that narrow and wide lobes are both resolved.
    t = alpha * np.tan((np.arange(RINGS) + 0.5) / RINGS * math.pi / 2)
    dt = alpha * (1 + (t / alpha) ** 2) * (math.pi / 2 / RINGS)
    phi = (np.arange(SECTORS) + 0.5) / SECTORS * math.pi
    cos_h = 1 / np.sqrt(1 + t * t)[:, None]
    sin_h = t[:, None] * cos_h
    dh = 2 * (cos_h**3 * t[:, None] * dt[:, None]) * (math.pi / SECTORS)  # sinθ dθ dφ, both halves
    vh = sin_h * np.cos(phi)[None] * math.sqrt(1 - cosine**2) + cos_h * cosine
    nl = 2 * vh * cos_h - cosine
    lit = (vh > 0) & (nl > 0)
    density = alpha**2 / (math.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)
    lam = lambda c: (np.sqrt(1 + alpha**2 * (1 - c * c) / (c * c)) - 1) / 2  # noqa: E731
    shadow = 1 / (1 + lam(np.where(lit, nl, 1.0)) + lam(cosine))
    value = np.where(lit, density * shadow * vh / cosine * dh, 0.0)
    schlick, dielectric = (1 - np.clip(vh, 0, 1)) ** 5, fresnel_of_dielectric(vh)
    return float((value * (1 - schlick)).sum()), float((value * schlick).sum()), float((value * dielectric).sum())


@lru_cache(maxsize=64)
def mean_bright(roughness: float) -> float:
    """2 ∫ E μ dμ of the albedo E that the lobe has with a Fresnel term of 1."""
    at = (np.arange(24) + 0.5) / 24
    return float(sum(sum(single_scattering(float(c), roughness)[:2]) * 2 * c for c in at) / 24)


def between_microfacets(cosine: float, roughness: float, average: float) -> float:
    """Factor on the albedo by light scattered between microfacets, whose mean Fresnel term is `average`."""
    return float(scattered_again(mean_bright(roughness), sum(single_scattering(cosine, roughness)[:2]), average))


def scattered_again(mean: Any, bright: Any, average: Any) -> Any:
    """The same from the albedo `bright` that the lobe has with a Fresnel term of 1, and its mean over the hemisphere."""
    return 1 + average * mean / (1 - average * (1 - mean)) * (1 - bright) / bright


def albedo_of_conductor(cosine: float, roughness: float, f0: float) -> float:
    """Directional albedo of a conductor with Schlick's Fresnel term."""
    scale, bias, _ = single_scattering(cosine, roughness)
    return (f0 * scale + bias) * between_microfacets(cosine, roughness, f0 + (1 - f0) / 21)


def albedo_of_dielectric(cosine: float, roughness: float) -> float:
    """Directional albedo of the specular layer of a dielectric of index of refraction 1.5."""
    return single_scattering(cosine, roughness)[2] * between_microfacets(cosine, roughness, MEAN_DIELECTRIC)
