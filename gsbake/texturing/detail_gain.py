"""Detail that averaging takes away, and how much of it the views have in common.

The mean of views that lie a part of a pixel beside each other is blurred: it keeps less energy in fine bands than each view has, and mixes
what the views share with what each of them has alone (noise, reflections, misplaced detail). On patches of the texture that several views
show, three energies are measured in each band: that of the views E, that of their mean M, and the C that pairs of views have in common.
The mean's common part has the amplitude √C; √E is that of a view, and C / M the share of the mean that is common, so that a band is
amplified by √(E C) / M: 1 where views agree, and where they have nothing in common there is nothing to amplify. Bands as of Burt & Adelson,
*A multiresolution spline with application to image mosaics*, ACM TOG 1983; the low band stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.imaging.srgb import LUMINANCE
from gsbake.texturing.projection import ProjectionBlender
from gsbake.texturing.texels import Texels
from gsbake.texturing.view_fusion import SHARPNESS

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Halves = NDArray[np.float16]
Flags = NDArray[np.bool_]
Bytes = NDArray[np.uint8]

#: Bands of luminance (square root of the linear one) between Gaussians of these standard deviations in texels, from none on.
SIGMAS = (1.0, 2.0, 4.0)
#: Edge of a patch, and the margin on each side that the Gaussians of its neighbourhood would change, in texels; number of patches.
PATCH, MARGIN, PATCHES = 32, 8, 600
#: Standard deviations beyond which a Gaussian has next to nothing (.6 % of what lies there).
REACH = 2.5
#: Least views that show a patch, and least weight of one beside the best.
MIN_VIEWS, MIN_WEIGHT = 3, 0.05
#: Fewer patches are no evidence; largest gain; largest factor of a texel's coded luminance, which counts as at least `DARKEST`.
MIN_PATCHES, MAX_GAIN, MAX_FACTOR, DARKEST = 20, 1.5, 2.5, np.float32(0.02)


@dataclass
class DetailEnergy:
    """Sums over `patches` patches of the energies (bands,) of single `views`, of their `mean`, and of what is `common` to pairs."""

    views: Doubles = field(default_factory=lambda: np.zeros(len(SIGMAS)))
    mean: Doubles = field(default_factory=lambda: np.zeros(len(SIGMAS)))
    common: Doubles = field(default_factory=lambda: np.zeros(len(SIGMAS)))
    patches: int = 0

    def add(self, blender: ProjectionBlender, texels: Texels, rows: tuple[int, int], most: int, gains: Floats) -> None:
        """Measure `most` patches of the `texels` of `blender`, which lie in these `rows` of the texture, the views' exposure `gains`
        (views, 3) divided out."""
        lookup = np.full((rows[1] - rows[0], texels.size), -1, np.int64)
        lookup.ravel()[texels.index - rows[0] * texels.size] = np.arange(len(texels))
        down, across = (length // PATCH for length in lookup.shape)
        blocks = lookup[: down * PATCH, : across * PATCH].reshape(down, PATCH, across, PATCH).transpose(0, 2, 1, 3).reshape(-1, PATCH**2)
        whole = blocks[(blocks >= 0).all(1)]
        for patch in whole[:: max(1, len(whole) // max(1, most))]:
            self._add_patch(*blender.samples(patch, gains))

    def _add_patch(self, values: Doubles, weights: Floats, views: NDArray[np.int16]) -> None:
        """One patch of samples (p, keep, 3), linear, with weights and views (p, keep)."""
        shown = [view for view in np.unique(views) if view >= 0 and (views == view).any(1).all()]
        if len(shown) < MIN_VIEWS:
            return
        at, texel = np.stack([(views == view).argmax(1) for view in shown]), np.arange(len(views))
        weight = weights[texel, at].mean(1, dtype=np.float64)
        root = np.sqrt(values[texel, at] @ LUMINANCE)
        usable = weight > MIN_WEIGHT * weight.max()
        if usable.sum() < MIN_VIEWS:
            return
        weight = weight[usable] ** SHARPNESS / (weight[usable] ** SHARPNESS).sum()
        finer = [plane.reshape(PATCH, PATCH).astype(np.float32) for plane in root[usable]]
        alone = float((weight**2).sum())
        for band, sigma in enumerate(SIGMAS):
            low = [cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_REFLECT) for plane in finer]
            inner = slice(MARGIN, -MARGIN)
            high = np.stack([(fine - smooth)[inner, inner].ravel() for fine, smooth in zip(finer, low, strict=True)]).astype(np.float64)
            energy, mean = (high**2).mean(1), float(((weight @ high) ** 2).mean())
            self.views[band] += weight @ energy
            self.mean[band] += mean
            # The mean of all pairs of different views, without a loop over pairs.
            self.common[band] += (mean - weight**2 @ energy) / (1 - alone)
            finer = low
        self.patches += 1

    @property
    def gains(self) -> tuple[float, ...]:
        """The factor (1 … MAX_GAIN) by which each band of the mean is amplified."""
        if self.patches < MIN_PATCHES:
            return (1.0,) * len(SIGMAS)
        gain = np.sqrt(self.views * np.maximum(self.common, 0)) / np.maximum(self.mean, 1e-12)
        return tuple(float(x) for x in np.clip(gain, 1, MAX_GAIN))

    @property
    def evidence(self) -> str:
        """What the gains were chosen by."""
        if self.patches < MIN_PATCHES:
            return f"{self.patches} patches of the texture are shown whole by {MIN_VIEWS} photos, at least {MIN_PATCHES} are needed"
        kept, common = (
            ", ".join(f"{100 * max(0.0, x):.0f}" for x in part / np.maximum(self.views, 1e-12)) for part in (self.mean, self.common)
        )
        return f"the mean keeps {kept} % of the photos' energy in bands of 1, 2 and 4 texels; {common} % is common to the photos"


def detail_factor(colour: Halves, observed: Flags, gains: Sequence[float], charts: Bytes) -> Floats:
    """Factors (n, n) on linear `colour` (n, n, 3) that amplify its bands of luminance by `gains`; 1 where it is not `observed` (n, n).

    `charts` (n, n) are `chart_codes`: a band is amplified only where its Gaussians reach no other chart.
    """
    known = observed.astype(np.float32)
    root = sum(weight * colour[..., channel].astype(np.float32) for channel, weight in enumerate(LUMINANCE))
    root = np.sqrt(np.maximum(root, 0)) * known
    finer, change, spread = root, np.zeros_like(root), 0.0
    for sigma, gain in zip(SIGMAS, gains, strict=True):
        low = cv2.GaussianBlur(root, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(known, (0, 0), sigma), 1e-6)
        spread = float(np.hypot(spread, sigma))
        foreign = near_other_charts(charts, round(REACH * spread))
        change += np.where(foreign, np.float32(0), np.float32(gain - 1)) * (finer - low)
        finer = low
    change /= np.maximum(root, DARKEST)
    return np.where(observed, np.clip(1 + change, 1 / MAX_FACTOR, MAX_FACTOR) ** 2, np.float32(1))


def chart_codes(chart: NDArray[np.int32]) -> Bytes:
    """Codes (n,) 1 … 255 of the numbers of charts; the same for a few of many."""
    return (1 + chart % 255).astype(np.uint8)


def near_other_charts(charts: Bytes, reach: int) -> Flags:
    """Where (n, n) texels of charts with different codes, 0 = none, lie within `reach` texels on both axes."""
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    # 0 becomes the largest, so that empty texels count in neither.
    return np.asarray(cv2.dilate(charts, window) - np.uint8(1) != cv2.erode(charts - np.uint8(1), window)) & (charts > 0)
