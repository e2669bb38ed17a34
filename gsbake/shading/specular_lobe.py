"""The specular lobe of GGX seen at an angle, as the two lobes that prefiltered light has.

The split sum takes the light from one prefiltered map whose lobe is that of normal incidence, n = v = r (`prefilter`). Seen at an angle the
lobe is narrower across the plane of incidence, skewed along it, and has a wide tail, and under lamps hundreds of times as bright as their
surroundings that decides: for a metal of roughness .3 seen at n·v = .4 a lamp's reflection came out twice as wide. So here

    lobe(l) ≈ (1 − s) · P(l; d, ρ) + s · max(n·l, 0) / π,     d ∝ (1 + m (2 n·v − 1)) n − m v,

with P the prefiltered lobe of roughness ρ around d: both terms are looked up anyway, for reflection and for irradiance. The share s, the
roughness ρ and the weight m of the mirror direction (1: d is the mirror direction, 0: the normal) depend on roughness and n·v alone.
`fit_lobe` finds them by least squares: the light is a single lamp, of several widths and fluxes, anywhere on the sphere, and errors are of
displayed sRGB values: the peak of a bright lamp is clipped, so that the lobe's flanks count.

`python -m gsbake.shading.specular_lobe` fits the nodes again and writes `specular_lobe.csv`, which `lobe_table` interpolates.

Walter, Marschner, Li & Torrance, *Microfacet models for refraction through rough surfaces*, EGSR 2007 (GGX); Heitz, JCGT 2014 (masking);
Karis, *Real Shading in Unreal Engine 4*, 2013 (split sum).
"""

from __future__ import annotations

import csv
import sys
from dataclasses import astuple, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares
from scipy.special import expit, logit

from gsbake.imaging.srgb import encode
from gsbake.shading import cubemap

Floats = NDArray[np.float64]

FILE = Path(__file__).with_name("specular_lobe.csv")
#: Fitted roughnesses, and square roots of n·v. At roughness 0 the lobe is the mirror direction.
ROUGHNESS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
ROOT_COSINE = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
#: Fluxes of the lamp: radiance times solid angle, white being 1. Its standard deviations in degrees.
LAMP_FLUXES, LAMP_WIDTHS = (0.01, 0.03, 0.1, 0.3, 1.0), (4.0, 16.0)
#: Edges of the cube maps of directions of light, and of lamps.
EDGE, LAMP_EDGE = 64, 20
#: Lowest roughness of the prefiltered lobe in the fit, and the weight that keeps parameters near those of the node before, where the
#: residual leaves them open.
MIN_ROUGHNESS, CONTINUITY = 0.03, 0.003


@dataclass(frozen=True)
class SpecularLobe:
    """`share` of the cosine lobe, `roughness` ρ of the prefiltered one, and weight `mirror` of the mirror direction in its direction."""

    share: float
    roughness: float
    mirror: float


@lru_cache(maxsize=2)
def _half_sphere(edge: int) -> tuple[Floats, Floats]:
    """Directions (n, 3) with y ≥ 0, as the lobe is symmetric in y, and twice their solid angles (n,)."""
    every, area = cubemap.directions(edge).reshape(-1, 3), cubemap.solid_angles(edge).ravel()
    half = every[:, 1] >= 0
    return np.asarray(every[half], np.float64), 2 * np.asarray(area[half], np.float64)


@lru_cache(maxsize=1)
def _lamps() -> tuple[NDArray[np.float32], Floats]:
    """Weights (lamps, n) of the directions of `_half_sphere` under lamps of all widths, and what each lamp's squared error counts."""
    (light, area), (lamp, lamp_area) = _half_sphere(EDGE), _half_sphere(LAMP_EDGE)
    blocks = []
    for width in np.radians(LAMP_WIDTHS):
        both = np.exp((lamp @ light.T - 1) / width**2) + np.exp((lamp @ (light * [1, -1, 1]).T - 1) / width**2)
        blocks.append(both * area / (both @ area)[:, None])
    share = np.tile(lamp_area / lamp_area.sum(), len(LAMP_WIDTHS)) / len(LAMP_WIDTHS)
    return np.concatenate(blocks).astype(np.float32), share


def ggx_density(light: Floats, roughness: float, cosine: float) -> Floats:
    """GGX · n·l, without Fresnel (n,), towards `light` (n, 3), for n = +Z and a view in the x–z plane with n·v = `cosine`."""
    squared, nl = roughness**4, np.clip(light[:, 2], 0, 1)
    half = light + [np.sqrt(1 - cosine**2), 0, cosine]
    nh = np.clip(half[:, 2] / np.maximum(np.linalg.norm(half, axis=1), 1e-9), 0, 1)
    density = squared / (np.pi * (nh**2 * (squared - 1) + 1) ** 2)
    smith = nl * np.sqrt(squared + (1 - squared) * cosine**2) + cosine * np.sqrt(squared + (1 - squared) * nl**2)
    return np.asarray(density * nl / (2 * np.maximum(smith, 1e-12)))


def prefiltered_density(light: Floats, roughness: float, direction: Floats) -> Floats:
    """The lobe of `prefilter` (n,) around a unit `direction` (3,), unnormalised."""
    cosine = light @ direction
    return np.asarray(np.where(cosine > 0, cosine, 0) / ((1 + cosine) / 2 * (roughness**4 - 1) + 1) ** 2)


def fit_lobe(roughness: float, cosine: float, start: Floats | None = None) -> tuple[SpecularLobe, Floats]:
    """The best lobe at `roughness` and n·v = `cosine`, and its parameters as the `start` (3,) of the next node's fit."""
    light, area = _half_sphere(EDGE)
    lamps, share_of_lamp = _lamps()
    weight = np.sqrt(share_of_lamp)

    def normalised(density: Floats) -> Floats:
        return np.asarray(density / (density @ area))

    def displayed(density: Floats) -> list[NDArray[Any]]:
        seen = lamps @ density.astype(np.float32)
        return [encode(np.minimum(flux * seen, 1)) * weight for flux in LAMP_FLUXES]

    truth, wide = displayed(normalised(ggx_density(light, roughness, cosine))), normalised(np.clip(light[:, 2], 0, 1))

    def unpacked(parameters: Floats) -> tuple[float, float, float]:
        share, rough, angle = parameters
        return float(expit(share)), float(MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * expit(rough)), float(angle)

    def residual(parameters: Floats) -> Floats:
        share, rough, angle = unpacked(parameters)
        narrow = normalised(prefiltered_density(light, rough, np.array([-np.sin(angle), 0, np.cos(angle)])))
        found = displayed((1 - share) * narrow + share * wide)
        return np.concatenate([*(f - t for f, t in zip(found, truth, strict=True)), CONTINUITY * (parameters - first)])

    narrower = np.clip((roughness * cosine**0.4 - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS), 0.02, 0.95)
    first = np.array([-3.0, logit(narrower), np.arccos(cosine)]) if start is None else start
    best = np.asarray(least_squares(residual, first, diff_step=1e-3).x)
    share, rough, angle = unpacked(best)
    return SpecularLobe(share, rough, _mirror_weight(angle, cosine)), best


def _mirror_weight(angle: float, cosine: float) -> float:
    """The m for which (1 + m (2c − 1)) n − m v points at `angle` from the normal n, away from v; c is the `cosine`."""
    sine = np.sqrt(1 - cosine**2)
    if sine < 1e-6:  # n = v: the direction is the normal for every m
        return 1.0
    ratio = np.sin(angle) / (np.cos(angle) * sine + np.sin(angle) * cosine)  # of v to n
    return float(ratio / (1 - ratio * (2 * cosine - 1)))


def lobe_table(roughness: NDArray[Any], root_cosine: NDArray[Any]) -> Floats:
    """Share, roughness and mirror weight (n, 3) of the lobe at `roughness` (n,) and √(n·v) (n,); linear between the fitted nodes."""
    with FILE.open(encoding="utf-8", newline="") as file:
        rows = [[float(x) for x in row] for row in list(csv.reader(file))[1:]]
    nodes = np.array(rows)[:, 2:].reshape(len(ROUGHNESS), len(ROOT_COSINE), 3)
    nodes = np.concatenate([np.broadcast_to([0.0, 0.0, 1.0], (1, *nodes.shape[1:])), nodes])
    table = RegularGridInterpolator(((0, *ROUGHNESS), ROOT_COSINE), nodes)
    at = np.stack([np.clip(roughness, 0, 1), np.clip(root_cosine, ROOT_COSINE[0], 1)], -1)
    return np.asarray(table(at))


def main() -> None:
    """Fit all nodes and write them."""
    rows = []
    for root in ROOT_COSINE:
        start = None
        for roughness in ROUGHNESS:
            lobe, start = fit_lobe(roughness, root**2, start)
            rows.append((roughness, root, *(round(value, 4) for value in astuple(lobe))))
    with FILE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["roughness", "root_cosine", "share", "lobe_roughness", "mirror"])
        writer.writerows(sorted(rows))
    sys.stdout.write(f"{FILE}: {len(rows)} nodes\n")


if __name__ == "__main__":
    main()
