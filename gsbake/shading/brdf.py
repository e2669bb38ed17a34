"""Split-sum table: directional albedo of GGX, for conductors as scale and bias of F0, and for dielectrics.

Karis, *Real Shading in Unreal Engine 4*, 2013: with Schlick's Fresnel term, ∫ f (n·l) dl = F0·A(n·v, roughness) + B(n·v, roughness). Here
the microfacet model is that of the glTF specification and of Cycles: GGX with α = roughness² and the height-correlated Smith term

    G2/G1(v) = n·l (n·v + Λ_v) / (n·l Λ_v + n·v Λ_l),   Λ_x = √(α² + (1 − α²)(n·x)²)      (Heitz, JCGT 2014)

Half-vectors are sampled from the visible normals (Dupuy & Benyoub, *Sampling Visible GGX Normals with Spherical Caps*, HPG 2023) on a
stratified grid. Each sample has the weight G2/G1 ≤ 1, so a small grid is accurate down to grazing angles.

**Dielectrics** have a table of their own, D(n·v, roughness), with Fresnel's equations at the index of refraction 1.5 (F0 = .04). Schlick's
term is made for metals: at 45 to 65° it reflects 14 to 19 % less than a dielectric does, and that the light is brighter would be the only
way to explain it.

**Light scattered between microfacets** is added as by Kulla & Conty, *Revisiting physically based shading at Imageworks*, 2017: albedos are
multiplied by 1 + F_ms (1 − E)/E, with E = A + B, its cosine-weighted mean Ē, F_ms = F̄ Ē / (1 − F̄ (1 − Ē)) and the mean Fresnel term F̄. For
conductors that is not linear in F0. The searches need it linear: A and B ≥ 0 are those of the straight line with the least relative error
from F0 = .3 to 1 (`METALS`): at roughness .56 within 5 % of Cycles, at .9 within 27 % (`benchmarks.furnace`).

The same table has the parameters of the lobe from which the light comes (`specular_lobe`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.shading.specular_lobe import lobe_table

Doubles = NDArray[np.float64]

#: Table nodes along √(n·v) and along roughness, both from 0 to 1 inclusive. The square root places more nodes at grazing angles, where the
#: curvature of A and B is high.
COSINE_NODES = 48
ROUGHNESS_NODES = 32
#: Columns of the table.
COLUMNS = 6
#: Index of refraction of dielectrics, as glTF has it: F0 = .04.
IOR = 1.5
#: Range of F0 over which conductors' albedo is taken as linear.
METALS = (0.3, 1.0)


def dielectric_fresnel(cosine: NDArray[Any]) -> Doubles:
    """Reflectance (n,) of a dielectric for unpolarised light at the cosine (n,) of incidence (Fresnel's equations at `IOR`)."""
    c = np.asarray(cosine, np.float64)
    g = np.sqrt(IOR**2 - 1 + c * c)
    parallel = (c * (g + c) - 1) / (c * (g - c) + 1)
    return np.asarray(0.5 * ((g - c) / (g + c)) ** 2 * (1 + parallel**2))


def directional_albedo(cosine: NDArray[np.float64], alpha: NDArray[np.float64], strata: int = 32) -> NDArray[np.float64]:
    """A, B and D (n, 3) of a single scattering at n·v (n,) and α (n,), from strata² samples each; `cosine` may be 0."""
    k = (np.arange(strata) + 0.5) / strata
    phi, cap = (g.ravel()[None] for g in np.meshgrid(np.pi * k, k))  # symmetric lobe: half of the azimuths
    nv, a = cosine[:, None], alpha[:, None]
    sin_v = np.sqrt(np.clip(1.0 - nv * nv, 0.0, None))
    stretch = 1.0 / np.sqrt((a * sin_v) ** 2 + nv**2 + 1e-30)
    vx, vz = a * sin_v * stretch, nv * stretch
    z = (1.0 - cap) * (1.0 + vz) - vz
    ring = np.sqrt(np.clip(1.0 - z * z, 0.0, None))
    hx, hy, hz = a * (ring * np.cos(phi) + vx), a * ring * np.sin(phi), np.clip(z + vz, 0.0, None) + 1e-12
    length = 1.0 / np.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hz = hx * length, hz * length
    vh = np.clip(hx * sin_v + hz * nv, 0.0, 1.0)
    nl = 2.0 * vh * hz - nv
    lit = nl > 0
    nl = np.where(lit, nl, 1.0)
    smith_v = np.sqrt(a * a + (1.0 - a * a) * nv * nv)
    smith_l = np.sqrt(a * a + (1.0 - a * a) * nl * nl)
    weight = np.where(lit, nl * (nv + smith_v) / (nl * smith_v + nv * smith_l + 1e-30), 0.0)
    schlick = (1.0 - vh) ** 5
    return np.stack([(part * weight).mean(axis=1) for part in (1.0 - schlick, schlick, dielectric_fresnel(vh))], axis=1)


def with_multiple_scattering(albedo: Doubles, cosine: Doubles) -> Doubles:
    """A, B and D (rows, n, 3) with the light that is scattered between microfacets, from those of a single scattering at n·v `cosine` (n,),
    one row for each roughness."""
    bright = albedo[..., 0] + albedo[..., 1]
    lost = (1 - bright) / np.maximum(bright, 1e-6)
    mean = _hemispherical(bright, cosine)[:, None]

    def factor(fresnel: float) -> Doubles:
        again = fresnel * mean / (1 - fresnel * (1 - mean))
        return np.asarray(1 + again * lost)

    f0 = np.linspace(*METALS, 15)
    # Mean of Schlick's term over the hemisphere: F0 + (1 − F0) / 21.
    exact = np.stack([(f * albedo[..., 0] + albedo[..., 1]) * factor(f + (1 - f) / 21) for f in f0], -1)
    columns = np.stack([f0 / exact, 1 / exact], -1)  # both shall add up to 1
    squares, sums = np.einsum("...kd,...ke->...de", columns, columns), columns.sum(-2)
    line = np.linalg.solve(squares, sums[..., None])[..., 0]
    scale = np.where(line[..., 1] < 0, sums[..., 0] / squares[..., 0, 0], line[..., 0])
    every = np.linspace(0, 1, 401)
    dielectric = albedo[..., 2] * factor(float(_hemispherical(dielectric_fresnel(every)[None], every)[0]))
    return np.stack([scale, np.maximum(line[..., 1], 0), dielectric], -1)


def _hemispherical(value: Doubles, cosine: Doubles) -> Doubles:
    """2 ∫ value · μ dμ (rows,) of values (rows, n) at increasing cosines μ (n,) from 0 to 1."""
    return np.asarray(2 * np.trapezoid(value * cosine, cosine, axis=1))


@lru_cache(maxsize=1)
def split_sum_table() -> NDArray[np.float32]:
    """The table (ROUGHNESS_NODES, COSINE_NODES, COLUMNS), read-only; computed once per process.

    Columns: A, B, of the lobe the share of the cosine lobe, the roughness of the prefiltered one, and its mirror weight, and D.
    """
    rough, root = np.linspace(0.0, 1.0, ROUGHNESS_NODES), np.linspace(0.0, 1.0, COSINE_NODES)
    # A perfect mirror at grazing incidence is 0/0; 1e-4 gives its limit to five digits.
    cosine, alpha = np.maximum(root**2, 1e-4), np.maximum(rough**2, 1e-4)
    rows = [directional_albedo(cosine, np.full(COSINE_NODES, a)) for a in alpha]
    albedo = with_multiple_scattering(np.stack(rows), cosine)
    lobe = lobe_table(*(g.ravel() for g in np.meshgrid(rough, root, indexing="ij"))).reshape(*albedo.shape[:2], 3)
    table = np.concatenate([albedo[..., :2], lobe, albedo[..., 2:]], axis=2).astype(np.float32)
    table.flags.writeable = False
    return table


@lru_cache(maxsize=8)
def _table_tensor(dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    return torch.tensor(split_sum_table().reshape(-1, COLUMNS), dtype=dtype, device=device)


@dataclass(frozen=True)
class SplitSum:
    """A row of the split-sum table for n pixels, (n,) each: `scale` A and `bias` B of conductors' F0, of the lobe the `share` of the cosine
    lobe, `roughness` of the prefiltered one and weight `mirror` of the mirror direction in its direction; `dielectric`, albedo D."""

    scale: torch.Tensor
    bias: torch.Tensor
    share: torch.Tensor
    roughness: torch.Tensor
    mirror: torch.Tensor
    dielectric: torch.Tensor


def split_sum(cosine: torch.Tensor, roughness: torch.Tensor) -> SplitSum:
    """The table at n·v (n,) > 0 and roughness (n,); bilinear in √(n·v) and roughness; differentiable in both."""
    lut = _table_tensor(cosine.dtype, cosine.device)
    x = cosine.sqrt() * (COSINE_NODES - 1)
    y = roughness.clamp(0.0, 1.0) * (ROUGHNESS_NODES - 1)
    col = x.detach().floor().long().clamp(0, COSINE_NODES - 2)
    row = y.detach().floor().long().clamp(0, ROUGHNESS_NODES - 2)
    fx, fy = (x - col).unsqueeze(1), (y - row).unsqueeze(1)
    base = row * COSINE_NODES + col
    top = lut[base] * (1.0 - fx) + lut[base + 1] * fx
    bottom = lut[base + COSINE_NODES] * (1.0 - fx) + lut[base + COSINE_NODES + 1] * fx
    return SplitSum(*(top * (1.0 - fy) + bottom * fy).T)
