"""Kernel of the rows of parallax of surfaces without reflections: one colour per vertex, in closed form, with weights of the photos.

    m = Σ w ρ I / Σ w ρ,      ρ = 1 / (1 + |I − m|² / 2σ²),      σ² = Σ w |I − m|² / Σ w + floor²  of the plain mean

h = Σ w ρ (J − J̄)² and g = Σ w ρ (J − J̄)(I − m), J the photos' slopes along the normal and J̄ their mean (variable projection: Golub &
Pereyra, SIAM J. Numer. Anal. 1973).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbake.kernels.declaration import kernel

#: Rounds of reweighting.
ROUNDS = 2


@kernel("i8, i8, f4[:, :, ::1], f4[:, :, ::1], f4[:, ::1], f8, f8[:, ::1]", error_model="numpy", nogil=True)
def parallax_rows(start: int, stop: int, colour: Any, slope: Any, weight: Any, floor: float, out: Any) -> None:
    """Fill `out` (v, 4) of the vertices start..stop: h, g, the mean of |I − m|² with the weights `weight` (v, photos) alone, and Σ w ρ.

    `colour` and `slope` (v, photos, 3); `floor` is the least deviation of a sample.
    """
    photos = weight.shape[1]
    used = np.empty(photos)
    for v in range(start, stop):
        out[v, :] = 0
        total = 0.0
        mean = np.zeros(3)
        for j in range(photos):
            used[j] = weight[v, j]
            total += used[j]
            for c in range(3):
                mean[c] += used[j] * colour[v, j, c]
        if total <= 0:
            continue
        mean /= total
        scale = 0.0
        for step in range(ROUNDS + 1):
            square_sum, share = 0.0, 0.0
            new = np.zeros(3)
            for j in range(photos):
                if weight[v, j] <= 0:
                    continue
                square = 0.0
                for c in range(3):
                    difference = colour[v, j, c] - mean[c]
                    square += difference * difference
                square_sum += weight[v, j] * square
                if step > 0:
                    used[j] = weight[v, j] / (1 + square / scale)
                share += used[j]
                for c in range(3):
                    new[c] += used[j] * colour[v, j, c]
            if step == 0:
                scale = 2 * (square_sum / total + floor * floor)
            else:
                for c in range(3):
                    mean[c] = new[c] / share
            out[v, 2] = square_sum / total
        share = 0.0
        mean_slope = np.zeros(3)
        for j in range(photos):
            share += used[j]
            for c in range(3):
                mean_slope[c] += used[j] * slope[v, j, c]
        out[v, 3] = share
        for j in range(photos):
            if used[j] <= 0:
                continue
            for c in range(3):
                row = slope[v, j, c] - mean_slope[c] / share
                out[v, 0] += used[j] * row * row
                out[v, 1] += used[j] * row * (colour[v, j, c] - mean[c])
