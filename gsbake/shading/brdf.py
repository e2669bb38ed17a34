"""Split-sum table: directional albedo of GGX as scale and bias of F0.

Karis, *Real Shading in Unreal Engine 4*, 2013: with Schlick's Fresnel term, ∫ f (n·l) dl = F0·A(n·v, roughness) + B(n·v, roughness). Here
the microfacet model is that of the glTF specification and of Cycles: GGX with α = roughness² and the height-correlated Smith term

    G2/G1(v) = n·l (n·v + Λ_v) / (n·l Λ_v + n·v Λ_l),   Λ_x = √(α² + (1 − α²)(n·x)²)      (Heitz, JCGT 2014)

Half-vectors are sampled from the visible normals (Dupuy & Benyoub, *Sampling Visible GGX Normals with Spherical Caps*, HPG 2023) on a
stratified grid. Each sample has the weight G2/G1 ≤ 1, so a small grid is accurate down to grazing angles.

The same table has the parameters of the lobe from which the light comes (`specular_lobe`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.shading.specular_lobe import lobe_table

#: Table nodes along √(n·v) and along roughness, both from 0 to 1 inclusive. The square root places more nodes at grazing angles, where the
#: curvature of A and B is high.
COSINE_NODES = 48
ROUGHNESS_NODES = 32


def directional_albedo(cosine: NDArray[np.float64], alpha: NDArray[np.float64], strata: int = 32) -> NDArray[np.float64]:
    """A and B (n, 2) at n·v (n,) and α (n,), from strata² samples each; `cosine` may be 0."""
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
    fresnel = (1.0 - vh) ** 5
    return np.stack([((1.0 - fresnel) * weight).mean(axis=1), (fresnel * weight).mean(axis=1)], axis=1)


@lru_cache(maxsize=1)
def split_sum_table() -> NDArray[np.float32]:
    """The table (ROUGHNESS_NODES, COSINE_NODES, 5), read-only; computed once per process.

    Columns: A, B, and of the lobe the share of the cosine lobe, the roughness of the prefiltered one, and its mirror weight.
    """
    rough, root = np.meshgrid(np.linspace(0.0, 1.0, ROUGHNESS_NODES), np.linspace(0.0, 1.0, COSINE_NODES), indexing="ij")
    # A perfect mirror at grazing incidence is 0/0; 1e-4 gives its limit to five digits.
    cosine, alpha = np.maximum(root.ravel() ** 2, 1e-4), np.maximum(rough.ravel() ** 2, 1e-4)
    rows = [directional_albedo(cosine[i : i + COSINE_NODES], alpha[i : i + COSINE_NODES]) for i in range(0, len(alpha), COSINE_NODES)]
    out = np.concatenate([np.concatenate(rows), lobe_table(rough.ravel(), root.ravel())], axis=1)
    table = out.reshape(ROUGHNESS_NODES, COSINE_NODES, 5).astype(np.float32)
    table.flags.writeable = False
    return table


@lru_cache(maxsize=8)
def _table_tensor(dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    return torch.tensor(split_sum_table().reshape(-1, 5), dtype=dtype, device=device)


@dataclass(frozen=True)
class SplitSum:
    """A row of the split-sum table for n pixels, (n,) each: `scale` A and `bias` B of F0, and the lobe's `share` of the cosine lobe,
    `roughness` of the prefiltered lobe and weight `mirror` of the mirror direction in its direction."""

    scale: torch.Tensor
    bias: torch.Tensor
    share: torch.Tensor
    roughness: torch.Tensor
    mirror: torch.Tensor


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
