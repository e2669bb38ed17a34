"""Measurements for skip rules of the bake: constant exposure, and normals that need no map. Each returns its evidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.exposure import MAX_SPREAD
from gsbake.texturing.normal_map import DenseSamples

#: Gains between photos below this factor count as view dependence, not exposure: dividing them out would remove reflections.
MAX_GAIN_SPREAD = 1.25
#: So do gains that explain less than this share of the differences between photos: exposure scales all of a photo equally, reflections do
#: not. With tie points a lower share is enough.
MIN_EXPLAINED, MIN_EXPLAINED_WITH_TIE_POINTS = 0.35, 0.1
#: No normal map is needed where normals deviate by less than this angle (degrees) at this share of the texels.
MAX_NORMAL_ANGLE, NORMAL_QUANTILE = 2.0, 0.95


def constant_exposure(gains: NDArray[Any], explained: float, tie_point_spread: float | None = None) -> tuple[bool, str]:
    """Whether all photos have one exposure, and the evidence.

    `gains` (photos, channels; 1 = none) are solved on the surface; `explained` is the share of the photos' differences there that they
    explain; `tie_point_spread` is the factor within which nine tenths of the photos agree at tie points (`capture.exposure`).
    """
    spread = float(np.exp(np.abs(np.log(gains)).max()))
    needed = MIN_EXPLAINED if tie_point_spread is None else MIN_EXPLAINED_WITH_TIE_POINTS
    evidence = f"gains on the surface up to {spread:.2f}x, threshold {MAX_GAIN_SPREAD:g}x"
    if spread >= MAX_GAIN_SPREAD:
        evidence += f"; they explain {100 * explained:.0f} % of the differences, threshold {100 * needed:g} %"
    if tie_point_spread is not None:
        evidence += f"; 90 % of tie points agree within {tie_point_spread:.2f}x, threshold {MAX_SPREAD:g}x"
    agreeing = tie_point_spread is not None and tie_point_spread < MAX_SPREAD
    return spread < MAX_GAIN_SPREAD or explained < needed or agreeing, evidence


def normals_agree(detail: DenseSamples, normal: NDArray[Any]) -> tuple[bool, str]:
    """Whether the low-poly mesh has the normals of the dense mesh, and the evidence.

    `normal` (n, 3) are the low-poly mesh's unit normals at the texels of `detail`. Texels without a dense surface are ignored.
    """
    if not detail.found.any():
        return True, "no dense surface near the low-poly mesh"
    cosine = np.einsum("nd,nd->n", detail.normal[detail.found], normal[detail.found])
    angle = float(np.degrees(np.arccos(np.clip(np.quantile(cosine, 1 - NORMAL_QUANTILE), -1, 1))))
    return angle < MAX_NORMAL_ANGLE, (
        f"{100 * NORMAL_QUANTILE:.0f} % of the normals are within {angle:.1f}° of the dense mesh, threshold {MAX_NORMAL_ANGLE:g}°"
    )
