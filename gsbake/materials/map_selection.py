"""Which material maps are needed: metallic and roughness are replaced by constants where validation views are reproduced as well.

Photos of a diffuse object hardly determine either, so per-texel values are mostly noise, which another environment makes visible.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: A constant may lower PSNR by this many dB.
MAX_PSNR_LOSS = 0.05
#: Up to this share of texels may be detected as metal by chance.
MAX_METAL_SHARE = 0.002

#: PSNR in dB of validation views with texel values (n, 5); None without views.
Psnr = Callable[[Floats], float | None]
#: Decides on a rule of `[skip]`: its name, whether the measurement allows to skip, the evidence, and the choices if skipped and if not.
Decide = Callable[[str, bool, str, str, str], bool]


def drop_unneeded_maps(values: Floats, weight: NDArray[Any], metals: int, psnr: Psnr, decide: Decide) -> Floats:
    """`values` (n, 5) (linear base colour, roughness, metallic) with constants in place of the maps that are not needed.

    `weight` (n,) is that of the pixels that show each texel, `metals` the number of texels detected as metal.
    """
    dielectric = without_metal(values)
    as_good, evidence = _compare(psnr(values), psnr(dielectric), "metallic 0")
    evidence = f"{metals} metallic texels; {evidence}"
    if decide("metallic_map", metals <= MAX_METAL_SHARE * len(values) and as_good, evidence, "metallic 0", "metallic mapped"):
        values = dielectric
    constant = with_constant_roughness(values, weight)
    name = f"roughness {constant[0, 3]:.2f}" if len(constant) else "constant roughness"
    as_good, evidence = _compare(psnr(values), psnr(constant), name)
    return constant if decide("roughness_map", as_good, evidence, name, "roughness mapped") else values


def without_metal(values: Floats) -> Floats:
    """`values` (n, 5) with metallic 0 and the same diffuse reflectance."""
    out = values.copy()
    out[:, :3] *= 1 - values[:, 4:]
    out[:, 4] = 0
    return out


def with_constant_roughness(values: Floats, weight: NDArray[Any]) -> Floats:
    """`values` (n, 5) with the median roughness, weighted by `weight` (n,), in all texels."""
    out = values.copy()
    order = np.argsort(values[:, 3], kind="stable")
    total = np.cumsum(np.asarray(weight, np.float64)[order])
    if len(total):
        out[:, 3] = values[order[np.searchsorted(total, 0.5 * total[-1])], 3]
    return out


def _compare(mapped: float | None, constant: float | None, name: str) -> tuple[bool, str]:
    """Whether the constant called `name` reproduces the views as well as the map, and the evidence."""
    if mapped is None or constant is None:
        return False, "no photos to compare"
    evidence = f"PSNR {constant:.2f} dB with {name}, {mapped:.2f} dB with a map; tolerance {MAX_PSNR_LOSS:g} dB"
    return constant > mapped - MAX_PSNR_LOSS, evidence
