"""SDF → opacity: the transfers of the literature, each with its inverse and the constants that training derives from it.

All are even functions of the dimensionless distance x = γ|s|, falling from `peak` at x = 0 to 0, written in t = e^{−x} so that nothing
overflows (the literal 4 e^{−γs} / (1 + e^{−γs})² is inf/inf below γs ≈ −88 in float32):

| name | o(x) | peak | after |
|---|---|---|---|
| sech2 | sech²(x/2) = 4t/(1+t)² | 1 | Zhu et al., ICCV 2025 (discretized SDF), eq. 5 |
| bell | t/(1+t)² | ¼ | Lyu et al., 3DGSR, 2024: the logistic density, not normalised |
| gaussian | e^{−x²} | 1 | the squared-exponential bump |
| laplace | 1 − e^{−τ t} | .99 | Yariv et al., VolSDF, NeurIPS 2021 |
| neus | 1 − Φ(x−c)/Φ(x+c) = 2 sinh(c) t/(1+e^c t) | .99 | Wang et al., NeuS, NeurIPS 2021, eq. 13; Φ the logistic CDF |

The last two are one-sided in their papers, opaque all through the solid. A surfel is a sample of a thin layer with nothing behind it,
so the law of the outside is taken on both sides, in |s|. Both need a thickness, which a disc does not have:

* laplace: density σ = γ Ψ(−γ|s|) = γ t/2 of the Laplace CDF Ψ over a layer of thickness δ along the normal gives 1 − e^{−σδ}, τ = γδ/2.
* neus: a ray enters the layer where the SDF is |s| + c/γ and leaves it where it is |s| − c/γ (met along the normal, where an SDF has
  slope 1), and α = (Φ(entry) − Φ(exit))/Φ(entry) with Φ at sharpness γ.

The layer is thin in proportion to 1/γ, the scale of Φ and Ψ; a layer as thick as the disc is wide (h ≈ .01) would leave α ≈ γh ≈ .05 at
the γ trained here. τ = c = ln 100 make a surfel on the zero set absorb .99, as much as the rasteriser lets one surfel absorb.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbake.errors import BadInputError

#: |s| (unit frame) below which the sharpness aimed at no longer follows the median, and the share of the peak it aims at there.
TARGET_MEDIAN_MIN, TARGET_SHARE = 0.1, 0.95

_C = math.log(100.0)
_EC = 100.0


@dataclass(frozen=True)
class Transfer:
    """One transfer: `value` maps x = γ|s| to opacity, `reach` maps opacities in (0, peak] back to x; `peak` is the opacity at s = 0."""

    name: str
    peak: float
    value: Callable[[Tensor], Tensor]
    inverse: Callable[[Tensor], Tensor]

    def opacity(self, sdf: Tensor, gamma: Tensor) -> Tensor:
        """Opacity in [0, peak] of SDF samples (n,) at sharpness `gamma` (scalar or (n,)); even in sdf."""
        return self.value((gamma * sdf).abs())

    def distance(self, alpha: Tensor, gamma: Tensor) -> Tensor:
        """|s| whose opacity is alpha at sharpness `gamma`; 0 where alpha is the peak or more, alpha below 1e-12 counts as 1e-12."""
        return self.inverse(alpha.clamp(1e-12, self.peak)).clamp_min(0) / gamma

    def half_width(self, share: float) -> float:
        """x at which the opacity is this share, in (0, 1], of the peak."""
        return float(self.inverse(torch.tensor(share * self.peak, dtype=torch.float64)))

    def target_sharpness(self, median: float) -> float:
        """Sharpness aimed at for a median |s| > 0: half the peak at the median while the samples are wide, then the constant γ with
        .95 of the peak at .1."""
        return self.half_width(0.5) / median if median > TARGET_MEDIAN_MIN else self.half_width(TARGET_SHARE) / TARGET_MEDIAN_MIN


def _bell(x: Tensor) -> Tensor:
    t = torch.exp(-x)
    return t / (1 + t) ** 2


def _sech2(x: Tensor) -> Tensor:
    t = torch.exp(-x)
    return 4 * t / (1 + t) ** 2


def _neus(x: Tensor) -> Tensor:
    t = torch.exp(-x)
    return (_EC - 1 / _EC) * t / (1 + _EC * t)


#: The transfers by name, as `surfels.transfer` of a profile names them.
TRANSFERS = {
    t.name: t
    for t in (
        Transfer("sech2", 1.0, _sech2, lambda a: 2 * torch.acosh(a.rsqrt().clamp_min(1))),
        Transfer("bell", 0.25, _bell, lambda a: 2 * torch.acosh((4 * a).rsqrt().clamp_min(1))),
        Transfer("gaussian", 1.0, lambda x: torch.exp(-x * x), lambda a: torch.sqrt(-torch.log(a))),
        Transfer("laplace", 1 - math.exp(-_C), lambda x: -torch.expm1(-_C * torch.exp(-x)), lambda a: torch.log(-_C / torch.log1p(-a))),
        Transfer("neus", 1 - math.exp(-_C), _neus, lambda a: torch.log((_EC - 1 / _EC - a * _EC) / a)),
    )
}
DEFAULT_TRANSFER = "sech2"


def transfer_by_name(name: str) -> Transfer:
    """The transfer of this name; BadInputError if there is none."""
    if name not in TRANSFERS:
        raise BadInputError(f"the surfels were trained with an unknown transfer {name!r}; this version knows {', '.join(TRANSFERS)}.")
    return TRANSFERS[name]
