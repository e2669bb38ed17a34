"""Which of the bake's steps a scene needs: exposure gains, and the normal map. Each answer comes with its evidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.texturing.normal_map import Detail

#: Gains between photos below this factor are taken for view dependence, not exposure: dividing them out would wash reflections away.
STEADY = 1.25
#: So are gains with which less than this share of the differences between photos goes: exposures change all of a photo alike, reflections
#: do not. Of constant exposures it is .01 to .06, of exposures that vary by .3 (root mean square of the logarithm) .17 even on gloss.
SHARED = 0.1
#: Tie points, which hardly shine, show changes of exposure from this factor on.
TIED = 1.15
#: A normal map is not needed where it would turn the mesh's own normals by less than this angle (degrees) ...
SMALL_TURN = 2.0
#: ... at this share of the texels.
NEARLY_ALL = 0.95


def constant_exposure(gains: NDArray[Any], explained: float, tied: float | None = None) -> tuple[bool, str]:
    """Whether the photos have one exposure, and the evidence: `gains` (photos, channels; 1 = none) solved on the surface, the share of the
    photos' differences there `explained` by them, and, because what shines changes by more than any exposure, the factor `tied` within
    which most photos agree at tie points (`capture.exposure`)."""
    spread = float(np.exp(np.abs(np.log(gains)).max()))
    evidence = f"photos compared on the surface differ by up to {spread:.2f}x; {STEADY:g}x may be view dependence"
    if spread >= STEADY:
        evidence += f"; one exposure per photo explains {100 * explained:.0f} % of their differences, {100 * SHARED:g} % are needed"
    if tied is not None:
        evidence += f"; at tie points nine tenths of them agree within {tied:.2f}x, {TIED:g}x may be chance"
    return spread < STEADY or explained < SHARED or (tied is not None and tied < TIED), evidence


def normals_agree(detail: Detail, normal: NDArray[Any]) -> tuple[bool, str]:
    """Whether the light mesh has the normals of the dense surface, and the evidence.

    `normal` (n, 3) are the light mesh's unit normals at the texels of `detail`. Texels that found no dense surface are passed over.
    """
    if not detail.found.any():
        return True, "the dense surface is found nowhere near the mesh"
    cosine = np.einsum("nd,nd->n", detail.normal[detail.found], normal[detail.found])
    turn = float(np.degrees(np.arccos(np.clip(np.quantile(cosine, 1 - NEARLY_ALL), -1, 1))))
    return turn < SMALL_TURN, (
        f"at {100 * NEARLY_ALL:.0f} % of the texels the mesh's normals are within {turn:.1f} degrees of the dense surface's; "
        f"{SMALL_TURN:g} are allowed"
    )
