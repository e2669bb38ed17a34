"""Prefiltered light: a flat table of octahedral levels, and its differentiable look-ups.

`prefilter_cube_map` applies the constant operator of `prefilter` in autograd. `LightTables` interpolates trilinearly over the octahedral
coordinates and roughness, differentiable with respect to table, directions and roughness. This module is PyTorch and runs on any device;
`split_sum_kernel` is the equivalent CPU kernel.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray

from gsbake.shading import octahedral
from gsbake.shading.prefilter import Layout, PrefilterOperator, irradiance_operator, prefilter_operator


def _sparse_tensor(matrix: scipy.sparse.csr_matrix, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    csr = matrix.tocsr(copy=True)  # the matrices are shared by fits that run at the same time
    csr.sort_indices()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        rows, columns, values = (torch.from_numpy(part) for part in (csr.indptr, csr.indices, csr.data))
        return torch.sparse_csr_tensor(rows, columns, values, csr.shape, dtype=dtype, check_invariants=True).to(device)


@dataclass(frozen=True, eq=False)
class _Matrices:
    """Those of `PrefilterOperator`."""

    reduce: torch.Tensor
    mirror: torch.Tensor
    octant: torch.Tensor
    place: torch.Tensor

    def __call__(self, radiance: torch.Tensor) -> torch.Tensor:
        """The table of a flattened map."""
        images = (self.mirror @ torch.cat([radiance, self.reduce @ radiance])).reshape(-1, 24)
        return self.place @ (self.octant @ images).reshape(-1, 3)


@lru_cache(maxsize=8)
def _matrices(op: PrefilterOperator, dtype: torch.dtype, device: torch.device, transposed: bool = False) -> _Matrices:
    """The matrices of an operator, each transposed if asked for."""
    return _Matrices(*(_sparse_tensor(m.T if transposed else m, dtype, device) for m in (op.reduce, op.mirror, op.octant, op.place)))


class _Filter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, radiance: torch.Tensor, size: int) -> torch.Tensor:
        ctx.size = size
        return _matrices(prefilter_operator(size), radiance.dtype, radiance.device)(radiance)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        grad = grads[0].contiguous()
        m = _matrices(prefilter_operator(ctx.size), grad.dtype, grad.device, True)
        both = m.mirror @ (m.octant @ (m.place @ grad).reshape(-1, 24)).reshape(-1, 3)
        fine = 6 * ctx.size**2
        return both[:fine] + m.reduce @ both[fine:], None


def clamp_straight_through(value: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """Clamp with a straight-through gradient, so that a parameter outside the range can return."""
    return value + (value.clamp(low, high) - value).detach()


@dataclass(frozen=True)
class LightTables:
    """Prefiltered light; `table` (layout.texels, 3) is linear RGB radiance."""

    table: torch.Tensor
    layout: Layout

    def specular(self, directions: torch.Tensor, roughness: torch.Tensor) -> torch.Tensor:
        """Radiance (n, 3) convolved with the GGX lobe at normal incidence around unit `directions` (n, 3), for `roughness` (n,).

        Linear between the roughness levels. Roughness outside their range gives the first or last level, with the gradient of the adjacent
        interval.
        """
        knots = torch.tensor(self.layout.roughness, dtype=roughness.dtype, device=roughness.device)
        rough = clamp_straight_through(roughness, self.layout.roughness[0], self.layout.roughness[-1])
        level = torch.bucketize(rough.detach(), knots[1:-1], right=True)
        t = ((rough - knots[level]) / (knots[level + 1] - knots[level])).unsqueeze(1)
        u, v = octahedral.encode(directions)
        return (1.0 - t) * self._bilinear(u, v, level) + t * self._bilinear(u, v, level + 1)

    def diffuse(self, normals: torch.Tensor) -> torch.Tensor:
        """Irradiance / π (n, 3) at unit `normals` (n, 3): the outgoing radiance of a white Lambertian surface."""
        u, v = octahedral.encode(normals)
        last = len(self.layout.sizes) - 1
        return self._bilinear(u, v, torch.full(u.shape, last, dtype=torch.long, device=u.device))

    def detach(self) -> LightTables:
        """A copy without gradient."""
        return LightTables(self.table.detach(), self.layout)

    def _bilinear(self, u: torch.Tensor, v: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
        size = torch.tensor(self.layout.sizes, device=u.device)[level]
        start = torch.tensor(self.layout.offsets, device=u.device)[level]
        x = (u + 1.0) * (0.5 * size) + 0.5
        y = (v + 1.0) * (0.5 * size) + 0.5
        # The clamp is on integers, so that NaN coordinates stay inside the table too.
        col = torch.minimum(x.detach().floor().long().clamp_min(0), size)
        row = torch.minimum(y.detach().floor().long().clamp_min(0), size)
        fx, fy = (x - col).unsqueeze(1), (y - row).unsqueeze(1)
        base = start + row * (size + 2) + col
        below = base + size + 2
        t00, t01, t10, t11 = (self.table.index_select(0, i) for i in (base, base + 1, below, below + 1))
        return (1.0 - fy) * ((1.0 - fx) * t00 + fx * t01) + fy * ((1.0 - fx) * t10 + fx * t11)


def prefilter_cube_map(radiance: torch.Tensor) -> LightTables:
    """Prefilter a cube map of radiance (6, N, N, 3), float32 or float64, on any device; differentiable once."""
    size = radiance.shape[1]
    return LightTables(_Filter.apply(radiance.reshape(-1, 3), size), prefilter_operator(size).layout)


@torch.no_grad()
def irradiance(radiance: NDArray[Any], normals: NDArray[Any]) -> NDArray[np.float32]:
    """Irradiance / π (n, 3) at unit `normals` (n, 3) under the cube map `radiance` (6, N, N, 3)."""
    light, directions = (torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in (radiance, normals))
    op = irradiance_operator(light.shape[1])
    table = _matrices(op, light.dtype, light.device)(light.reshape(-1, 3))
    return np.asarray(LightTables(table, op.layout).diffuse(directions).numpy())
