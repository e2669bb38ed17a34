"""Image metrics of the finished asset: PSNR and SSIM between photo and render.

Both images are composited over the same grey, the photo by its mask and the render by its alpha, and compared where either shows the
object: missing and superfluous parts count like wrong colours, and empty background does not raise the figures. Without masks only the
pixels that the asset covers are compared. SSIM after Wang et al., *Image quality assessment*, IEEE TIP 2004, with Gaussian weights,
averaged over the same pixels. Photos of one capture may differ in exposure, which no asset can know: a second PSNR gives the render the
exposure of the photo first, by one factor on linear values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsbake.capture.posed_photos import View
from gsbake.imaging.metrics import psnr, ssim
from gsbake.imaging.srgb import decode
from gsbake.report.render import Floats, RenderedImage

#: Background (sRGB value) of photo and render.
GREY = 0.5
#: Coverage from which a pixel shows the object alone, and value below which it is not clipped.
_OPAQUE, _UNCLIPPED = 0.99, 0.98


@dataclass(frozen=True)
class ImageMetrics:
    """Metrics of one view: `psnr` in dB over sRGB values, `exposed_psnr` with the photo's exposure, mean `ssim`, and the compared images
    (h, w, 3)."""

    psnr: float
    exposed_psnr: float
    ssim: float
    photo: Floats
    render: Floats


def compare(view: View, image: RenderedImage) -> ImageMetrics:
    """Metrics of a photo and a render of the same camera and size."""
    photo = view.rgb.astype(np.float32) / np.float32(255)
    if view.mask is None:
        alpha = image.alpha
        where = alpha > 0.5
    else:
        alpha = view.mask.astype(np.float32) / np.float32(255)
        where = (alpha > 0) | (image.alpha > 0)
    composited = photo * alpha[..., None] + np.float32(GREY) * (1 - alpha[..., None])
    render = image.over(GREY)
    # Without masks the page shows the whole photo; the figures are over the asset's pixels only.
    shown = photo if view.mask is None else composited
    plain = psnr(composited, render, where)
    both = (alpha > _OPAQUE) & (image.alpha > _OPAQUE)
    exposed = replace(image, linear=image.linear * np.float32(exposure_gain(photo[both], image.rgb[both]))).over(GREY)
    return ImageMetrics(plain, max(plain, psnr(composited, exposed, where)), ssim(composited, render, where), shown, render)


def exposure_gain(photo: Floats, render: Floats) -> float:
    """The factor on the linear values of `render` (n, 3) that brings them to the exposure of `photo` (n, 3); both sRGB-coded, 0..1.

    The ratio of the mean values of the pixels that are clipped in neither; 1 where there are none.
    """
    usable = (np.maximum(photo, render) < _UNCLIPPED).all(1)
    if not usable.any():
        return 1.0
    wanted, given = (float(decode(values[usable]).mean(dtype=np.float64)) for values in (photo, render))
    return wanted / max(given, 1e-6)


def select_views(count: int, held_out: list[int], views: int) -> tuple[list[int], bool]:
    """Indices of up to `views` evenly spread held-out photos, or of all photos when none is held out; and whether they are held out."""
    pool = held_out or list(range(count))
    if len(pool) <= views:
        return pool, bool(held_out)
    picks = [pool[round((i + 0.5) * len(pool) / views - 0.5)] for i in range(views)]
    return sorted(set(picks)), bool(held_out)
