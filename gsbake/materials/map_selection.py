"""Maps that an asset does not need: metal where there is none, roughness where one number shows the photos as well.

A matt thing's photos say next to nothing about either, so texel by texel the fit's values are mostly noise, and noise that another light
makes visible. What the fit found is judged against the plainer material on photos that took no part in it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: The plainer material may show the photos worse by this many dB.
TOLERANCE = 0.05
#: A thing without metal may have this share of texels that pass for it.
CHANCE = 0.002

#: PSNR in dB of photos when the texels have these values (n, 5); None without photos.
Judge = Callable[[Floats], float | None]
#: Decides on a rule of `[skip]`: its name, whether the evidence is enough, the evidence, and what is done if left out and if not.
Decide = Callable[[str, bool, str, str, str], bool]


def plainer(values: Floats, weight: NDArray[Any], metals: int, judge: Judge, decide: Decide) -> Floats:
    """`values` (n, 5) (linear base colour, roughness, metallic) without the maps that are not needed.

    `weight` (n,) is what the photos say about each texel, `metals` how many texels were found to be metal.
    """
    without = without_metal(values)
    as_good, evidence = _compared(judge(values), judge(without), "metallic 0")
    evidence = f"{metals} texels were found to be metal; {evidence}"
    if decide("metallic_map", metals <= CHANCE * len(values) and as_good, evidence, "metallic 0", "metallic mapped"):
        values = without
    alike = of_one_roughness(values, weight)
    number = f"roughness {alike[0, 3]:.2f}" if len(alike) else "one roughness"
    as_good, evidence = _compared(judge(values), judge(alike), number)
    return alike if decide("roughness_map", as_good, evidence, number, "roughness mapped") else values


def without_metal(values: Floats) -> Floats:
    """`values` (n, 5) with metallic 0 and the same diffuse reflectance."""
    out = values.copy()
    out[:, :3] *= 1 - values[:, 4:]
    out[:, 4] = 0
    return out


def of_one_roughness(values: Floats, weight: NDArray[Any]) -> Floats:
    """`values` (n, 5) with the median roughness, by `weight` (n,), in all texels."""
    out = values.copy()
    order = np.argsort(values[:, 3], kind="stable")
    total = np.cumsum(np.asarray(weight, np.float64)[order])
    if len(total):
        out[:, 3] = values[order[np.searchsorted(total, 0.5 * total[-1])], 3]
    return out


def _compared(mapped: float | None, plain: float | None, name: str) -> tuple[bool, str]:
    """Whether the photos are shown as well by the plainer material called `name`, and the evidence."""
    if mapped is None or plain is None:
        return False, "there are no photos to tell"
    evidence = f"photos are shown to {plain:.2f} dB with {name}, {mapped:.2f} dB with a map; {TOLERANCE:g} dB are allowed"
    return plain > mapped - TOLERANCE, evidence
