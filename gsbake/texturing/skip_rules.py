"""Measurements for skip rules of the bake: constant exposure, and normals that need no map. Each returns its evidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.exposure import MAX_SPREAD
from gsbake.monitor import Monitor
from gsbake.texturing.exposure_agreement import Agreement
from gsbake.texturing.normal_map import DenseSamples
from gsbake.texturing.view_fusion import disagreement

#: Photos differ in exposure where parts of the surface have at least the first share of the variance of gains in common. The second where
#: EXIF tells of their exposures: then what is left is light that moves with the camera or the object, unless it is nearly all.
MIN_COMMON_SHARE, MIN_COMMON_SHARE_WRITTEN = 0.12, 0.7
#: Exposures within this factor are one: cameras round what they write.
ONE_EXPOSURE = 1.03
#: Fewer pairs of parts, or fewer photos, say nothing.
MIN_PAIRS, MIN_PHOTOS = 10, 20
#: No normal map is needed where normals deviate by less than this angle (degrees) at this share of the texels.
MAX_NORMAL_ANGLE, NORMAL_QUANTILE = 2.0, 0.95


def believed_exposures(
    written: NDArray[np.float64] | None, logs: NDArray[np.float64], view: NDArray[np.int64], monitor: Monitor
) -> tuple[NDArray[np.float64] | None, str]:
    """The exposures to divide out by EXIF, None where they are equal or not known, and what EXIF says, "" where it is not believed.

    `written` are logarithms (photos,) or None, `logs` and `view` samples of the surface (`view_fusion.log_samples`). Exposures are believed
    with which photos differ less: photos that were edited since have others, as have those whose light changed.
    """
    if written is None or len(logs) == 0:
        return None, ""
    spread = float(np.exp(np.ptp(written)))
    if spread < ONE_EXPOSURE:
        return None, "EXIF gives all photos one exposure"
    gains = np.exp(written)[:, None]
    before, after = disagreement(logs, view, np.ones_like(gains)), disagreement(logs, view, gains)
    differ = f"photos differ by {100 * np.expm1(after):.0f} % on the surface with them, by {100 * np.expm1(before):.0f} % without"
    if after < before:
        return written, f"EXIF gives exposures within {spread:.1f}x: {differ}"
    monitor.decide("exposures by EXIF", "not used", f"within {spread:.1f}x, but {differ}")
    return None, ""


def constant_exposure(
    agreement: Agreement | None, photos: int, tie_point_spread: float | None = None, written: str = ""
) -> tuple[bool, str]:
    """Whether all `photos` have one exposure, and the evidence.

    `agreement` is that of their gains on the surface, `tie_point_spread` the factor within which nine tenths of them agree at tie points
    (`capture.exposure`), `written` says what EXIF knows of the exposures, which is divided out.
    """
    needed = MIN_COMMON_SHARE_WRITTEN if written else MIN_COMMON_SHARE
    evidence = [written] if written else []
    enough = agreement is not None and agreement.pairs >= MIN_PAIRS and photos >= MIN_PHOTOS
    differ = agreement is not None and enough and agreement.share >= needed
    if agreement is None:
        evidence.append("no parts of the surface that face different ways can be compared")
    else:
        common = (
            f"{100 * max(agreement.share, 0):.0f} ± {100 * agreement.error:.0f} % of the gains' variance is common to parts of the surface"
        )
        threshold = f"threshold {100 * needed:.0f} %" if enough else f"too few to tell (at least {MIN_PAIRS} and {MIN_PHOTOS})"
        evidence.append(f"{common} that face different ways ({agreement.pairs} pairs of {photos} photos), {threshold}")
    if tie_point_spread is not None and not written:
        evidence.append(f"90 % of the photos agree within {tie_point_spread:.2f}x at tie points, threshold {MAX_SPREAD:g}x")
        differ &= tie_point_spread >= MAX_SPREAD
    return not differ, "; ".join(evidence)


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
