"""How fine the texture is beside the photos: texels per pixel, the asset beside a part of a photo at full size, pixel for pixel, and where
it has how much of a photo's fine detail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.posed_photos import View
from gsbake.geometry.cameras import Camera
from gsbake.report.html import Figure, Panel, image_uri
from gsbake.report.quality import compare
from gsbake.report.render import Asset, Renderer, Shader, uv_density

#: Edge of the part of a photo that is shown, in pixels; and of the squares in which sharpness is measured.
EDGE, SQUARE = 400, 4
#: Longer side in pixels of the photo in which the map of detail is measured, rows that are drawn at once, and edge of its squares.
MAP_SIZE, MAP_ROWS, MAP_SQUARE = 1600, 200, 16
#: Detail of a photo, in levels of 255 (root mean square), below which it is noise and not compared.
LEAST_DETAIL = 1.5
#: Longer side of the render that tells where the object is.
OUTLINE_SIZE = 300


def texel_density(asset: Asset, cameras: Sequence[Camera], metric: bool) -> Figure:
    """Texels of the base colour per pixel of the median photo at the object's centre, for `cameras` of the full photos in the asset's
    frame; and per millimetre where the asset is `metric`."""
    height, width = asset.base_color.shape[:2]
    per_length = float(np.sqrt(uv_density(asset.position, asset.uv, asset.faces) * height * width))
    pixels = [float(np.linalg.norm(camera.centre - asset.centre)) / np.sqrt(camera.fx * camera.fy) for camera in cameras]
    note = "of a photo" + (f"; {1e-3 * per_length:.3g} per mm" if metric else "")
    return Figure("Texels", f"{per_length * float(np.median(pixels)):.2g} per pixel", note)


def close_up(renderer: Renderer, shader: Shader, photos: FullPhotos, camera: Camera, index: int) -> tuple[Panel, ...]:
    """The sharpest part of photo `index` at full size and the asset from its `camera` (asset frame); nothing where the asset fills none."""
    view = photos.view(index)
    full = camera.scaled(view.camera.width, view.camera.height)
    edge = min(EDGE, full.width, full.height)
    corner = sharpest_square(view.rgb, renderer.draw(full.downscaled_to(OUTLINE_SIZE), shader).alpha, edge)
    if corner is None:
        return ()
    left, top = corner
    part = slice(top, top + edge), slice(left, left + edge)
    window = replace(full, width=edge, height=edge, cx=full.cx - left, cy=full.cy - top)
    shown = View(window, view.rgb[part], None if view.mask is None else view.mask[part])
    beside = compare(shown, renderer.draw(window, shader))
    place = f"{edge} × {edge} of {full.width} × {full.height} pixels"
    return Panel(view.camera.name, place, image_uri(beside.photo)), Panel("Asset", "the same pixels", image_uri(beside.render))


def sharpest_square(rgb: NDArray[np.uint8], alpha: NDArray[Any], edge: int) -> tuple[int, int] | None:
    """Left and top of the square of `edge` pixels of a photo (h, w, 3) with the most detail on the object, whose `alpha` may be smaller;
    None where there is no object."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    detail = np.abs(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.CV_16S)).astype(np.float32)
    height, width = grey.shape
    size = max(1, width // SQUARE), max(1, height // SQUARE)
    small = cv2.resize(detail, size, interpolation=cv2.INTER_AREA)
    object_ = cv2.erode((cv2.resize(alpha, size, interpolation=cv2.INTER_AREA) > 0.99).astype(np.uint8), np.ones((3, 3), np.uint8))
    if not object_.any():
        return None
    across, down = (min(length, max(1, round(edge * length / whole))) for length, whole in zip(size, (width, height), strict=True))
    # Sums of all windows that lie in the photo, from their corners.
    total = cv2.integral(small * object_)
    sums = total[down:, across:] - total[:-down, across:] - total[down:, :-across] + total[:-down, :-across]
    y, x = np.unravel_index(int(sums.argmax()), sums.shape)
    return min(int(x) * width // size[0], width - edge), min(int(y) * height // size[1], height - edge)


def detail_panel(renderer: Renderer, shader: Shader, photos: FullPhotos, camera: Camera, index: int) -> tuple[Panel, ...]:
    """Map of the asset's fine detail beside that of photo `index` from its `camera` (asset frame); nothing where no square has any."""
    view = photos.view(index, MAP_SIZE)
    own = camera.scaled(view.camera.width, view.camera.height)
    # In bands, as a render takes some hundred bytes per ray.
    bands = [replace(own, height=min(MAP_ROWS, own.height - row), cy=own.cy - row) for row in range(0, own.height, MAP_ROWS)]
    drawn = [(image.rgb, image.alpha > 0.99) for image in (renderer.draw(band, shader) for band in bands)]
    render, whole = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    if view.mask is not None:
        whole &= view.mask > 250
    ratio = detail_ratio(view.rgb / np.float32(255), render, whole)
    known = np.isfinite(ratio)
    if not known.any():
        return ()
    coded = np.where(known, np.clip(255 * ratio, 0, 255), 0).astype(np.uint8)
    coloured = np.where(known[..., None], cv2.applyColorMap(coded, cv2.COLORMAP_VIRIDIS)[..., ::-1] / np.float32(255), np.float32(0.5))
    size = (MAP_SQUARE // 4 * known.shape[1], MAP_SQUARE // 4 * known.shape[0])
    caption = f"fine detail of the asset over the photo's: {float(np.median(ratio[known])):.2f} in the median"
    return (Panel("Sharpness", caption, image_uri(np.asarray(cv2.resize(coloured, size, interpolation=cv2.INTER_NEAREST), np.float32))),)


def detail_ratio(photo: NDArray[Any], render: NDArray[Any], whole: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Root mean square of the Laplacian of a render over that of its photo (h, w, 3), sRGB 0..1, in squares of MAP_SQUARE pixels; NaN
    where less than half of a square is object (`whole` (h, w)), or the photo has no detail."""
    inside = cv2.erode(whole.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(np.float32)
    size = max(1, whole.shape[1] // MAP_SQUARE), max(1, whole.shape[0] // MAP_SQUARE)

    def energy(image: NDArray[Any]) -> NDArray[np.float64]:
        grey = cv2.GaussianBlur(np.asarray(image.mean(2), np.float32), (0, 0), 0.7)
        return np.asarray(cv2.resize(inside * cv2.Laplacian(grey, cv2.CV_32F) ** 2, size, interpolation=cv2.INTER_AREA), np.float64)

    share, own, shown = cv2.resize(inside, size, interpolation=cv2.INTER_AREA), energy(photo), energy(render)
    usable = (share > 0.5) & (own > share * (LEAST_DETAIL / 255) ** 2)
    return np.where(usable, np.sqrt(shown / np.maximum(own, 1e-12)), np.nan)
