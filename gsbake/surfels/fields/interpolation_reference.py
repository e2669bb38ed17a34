"""Multilinear interpolation in plain PyTorch, any dtype and device: the twin of `interpolation`, gradients by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbake.surfels.fields.levels import BLOCKS, CORNERS, DENSE, EDGE, HASHED, PRIMES, Level, Levels


def corner_rows(level: Level, corner: Tensor) -> Tensor:
    """Row (n,) in the level's own table of integer corners (n, 3); -1 where there is none."""
    i, j, k = corner.unbind(1)
    if level.mode == DENSE:
        return (i * level.size[1] + j) * level.size[2] + k
    if level.mode == HASHED:
        wrap = 0xFFFFFFFF
        return ((i & wrap) ^ ((j * PRIMES[0]) & wrap) ^ ((k * PRIMES[1]) & wrap)) % level.rows
    assert level.index is not None
    table = torch.from_numpy(level.index).to(corner.device).long()
    if level.mode == CORNERS:
        return table[i, j, k]
    assert level.mode == BLOCKS
    block = table[i // EDGE, j // EDGE, k // EDGE]
    row = ((block * EDGE + i % EDGE) * EDGE + j % EDGE) * EDGE + k % EDGE
    return torch.where(block >= 0, row, -1)


def interpolate_reference(points: Tensor, table: Tensor, levels: Levels) -> tuple[Tensor, Tensor]:
    """As `interpolation.interpolate`; the gradient of the Jacobian by the points is left out here too."""
    outs, jacobians = [], []
    start = 0
    lower = torch.from_numpy(levels.lower).to(points)
    for level, scale_row in zip(levels.levels, levels.scale, strict=True):
        scale = torch.from_numpy(scale_row).to(points)
        size = torch.tensor(level.size, device=points.device)
        top = (size - 1).to(points)
        x = torch.nan_to_num((points - lower) * scale, nan=0.0)
        inside = (x >= 0) & (x <= top) & (size > 1) & torch.isfinite(points)
        x = torch.where(x < 0, torch.zeros_like(x), torch.where(x > top, top, x))
        base = torch.minimum(x.detach().long(), (size - 2).clamp_min(0))
        t = torch.where(size > 1, x - base.to(points), torch.zeros_like(x))
        slope = inside.to(points) * scale
        out, jacobian = points.new_zeros(len(points), table.shape[1]), points.new_zeros(len(points), 3, table.shape[1])
        for bits in range(8):
            step = torch.tensor([bits & 1, (bits >> 1) & 1, bits >> 2], device=points.device)
            if bool(((step == 1) & (size < 2)).any()):
                continue
            row = corner_rows(level, base + step)
            features = torch.where(row[:, None] >= 0, table[start + row.clamp_min(0)], 0.0)
            w = torch.where(step == 1, t, 1 - t)
            d = (slope * torch.where(step == 1, 1.0, -1.0).to(points)).detach()
            wd = w.detach()
            partial = torch.stack([d[:, 0] * wd[:, 1] * wd[:, 2], d[:, 1] * wd[:, 0] * wd[:, 2], d[:, 2] * wd[:, 0] * wd[:, 1]], 1)
            out = out + w.prod(1)[:, None] * features
            jacobian = jacobian + partial[:, :, None] * features[:, None]
        outs.append(out)
        jacobians.append(jacobian)
        start += level.rows
    return torch.cat(outs, 1), torch.cat(jacobians, 2)
