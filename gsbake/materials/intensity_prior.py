"""Prior of the light's intensity, for what photos leave open: a brighter light on a darker surface looks the same, on metal exactly so.

Three quantities are known roughly before any photo is looked at, and an intensity is likely where all of them are:

- the geometric mean of the strongest channel of dielectrics' base colours,
- the median of that of metals. Those of pure metals are tabulated (silver, aluminium, gold, copper, chromium, nickel, titanium, cobalt,
  platinum and iron: Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014, table 4),
- the mean radiance of a light that stands, since photographers expose for it: in it white paper is as bright as that. `python -m
  benchmarks.light_levels` measures environment maps that others have published. A flash, which moves with the camera, is one bright spot.

The logarithm of each follows Student's t with two degrees of freedom: some objects are black, and some lights those of a night. The light's
scale is that of the environment maps' quartiles; metals' .4 where the tabulated ones have .28, as worn and dirty ones differ more. Where
two quantities contradict each other such a prior has two modes, between which small changes would decide; so its mean is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbake.materials.materials import Materials
from gsbake.materials.visibility import LUMINANCE
from gsbake.shading.cubemap import solid_angles

#: Median, and scale of the logarithm, of base colours of dielectrics and of metals, and of the light's mean radiance.
DIELECTRICS, METALS, RADIANCE = (0.3, 0.66), (0.66, 0.4), (0.7, 0.29)
#: Least share of texels of a kind whose base colours count; what is added to those of dielectrics, so that black places do not decide.
MIN_SHARE, LOG_OFFSET = 0.05, 0.01
#: Factors on the intensity over which `mean_factor` integrates.
FACTORS = np.exp(np.linspace(-math.log(4), math.log(4), 121))


@dataclass(frozen=True)
class IntensityPrior:
    """Present means of the base colours of `dielectrics` and of `metals`, and of the light's `radiance`; None where one does not count."""

    dielectrics: float | None = None
    metals: float | None = None
    radiance: float | None = None

    @classmethod
    def of(cls, materials: Materials, dielectric: NDArray[np.bool_], radiance: NDArray[np.float32] | None) -> IntensityPrior:
        """The prior for texels with `materials`, of which some (n,) are `dielectric`, under the environment map `radiance` (6, s, s, 3),
        which does not count without."""
        strongest, metal = materials.base_color.max(1), materials.metallic > 0.5
        dielectrics = float(np.exp(np.log(strongest[dielectric] + LOG_OFFSET).mean())) if dielectric.mean() >= MIN_SHARE else None
        metals = float(np.median(strongest[metal])) if metal.mean() >= MIN_SHARE else None
        if radiance is None:
            return cls(dielectrics, metals)
        area = solid_angles(radiance.shape[1])
        return cls(dielectrics, metals, float(((radiance @ LUMINANCE) * area).sum() / area.sum()))

    def negative_log(self, factor: float) -> float:
        """−log of the prior, up to a constant, of the light times `factor`, under which base colours are divided by it."""
        known = ((self.dielectrics, 1 / factor, DIELECTRICS), (self.metals, 1 / factor, METALS), (self.radiance, factor, RADIANCE))
        return sum(_negative_log(value * change, *prior) for value, change, prior in known if value)

    def mean_factor(self) -> float:
        """The geometric mean of the factor on the intensity under the prior, between 1/4 and 4."""
        cost = np.array([self.negative_log(factor) for factor in FACTORS])
        density = np.exp(cost.min() - cost)
        return float(np.exp(density @ np.log(FACTORS) / density.sum()))


def _negative_log(value: float, median: float, scale: float) -> float:
    """−log of Student's t of log(value), up to a constant."""
    return 1.5 * math.log1p(0.5 * (math.log(value / median) / scale) ** 2)
