"""Images of the asset's textures, their channels, and the UV atlas with its charts."""

from __future__ import annotations

import colorsys
from pathlib import Path

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.imaging.exr import read_exr
from gsbake.imaging.srgb import encode
from gsbake.report.html import Panel, image_uri
from gsbake.report.render import Asset, Floats
from gsbake.text import number

#: Longer side of a map in the page in pixels.
MAX_MAP_SIZE = 768
#: Share of the texels whose rays missed the dense mesh from which on they are shown.
MIN_MISSED = 0.002


def downsample(image: Floats, longest: int = MAX_MAP_SIZE) -> Floats:
    """The image, at most `longest` pixels wide and high (area filter)."""
    height, width = image.shape[:2]
    if max(height, width) <= longest:
        return image
    scale = longest / max(height, width)
    small = cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def face_charts(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """Chart index (f,) of each face: connected components over shared vertices of the atlas."""
    a, b = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = scipy.sparse.coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(vertices, vertices))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, chart = np.unique(label[faces[:, 0]], return_inverse=True)
    return chart.astype(np.int32)


def uv_atlas_image(asset: Asset, edge: int = 1024) -> Floats:
    """UV atlas as an image (edge, edge, 3) in 0..1: charts in distinct colours with triangle edges, empty space dark."""
    chart = face_charts(asset.faces, len(asset.uv))
    sheet = np.full((edge, edge, 3), 34, np.uint8)
    # Fixed point with 4 fractional bits; OpenCV has pixel centres at integers.
    corners = np.round((asset.uv[asset.faces] * edge - 0.5) * 16).astype(np.int32)
    order = np.argsort(chart, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(chart[order])) + 1):
        hue = (int(chart[part[0]]) * 0.61803398875) % 1.0
        r, g, b = colorsys.hls_to_rgb(hue, 0.62, 0.45)
        for triangle in corners[part]:
            cv2.fillConvexPoly(sheet, triangle, (r * 255, g * 255, b * 255), lineType=cv2.LINE_8, shift=4)
    lines = np.zeros((edge, edge), np.uint8)
    cv2.polylines(lines, list(corners), True, 255, 1, cv2.LINE_AA, shift=4)
    share = np.float32(0.45 / 255) * lines.astype(np.float32)[..., None]
    return np.asarray(sheet / np.float32(255) * (1 - share) + share * np.float32(0.08), np.float32)


def map_panels(asset: Asset) -> tuple[Panel, ...]:
    """Panels of the asset's textures; missing ones are skipped."""

    def panel(title: str, caption: str, image: Floats) -> Panel:
        atlas = title == "UV atlas"
        return Panel(title, caption, image_uri(downsample(image)), "" if atlas else title.lower().replace(" ", "-"))

    def grey(channel: Floats) -> Floats:
        return np.repeat(channel[..., None], 3, axis=2)

    height, width = asset.base_color.shape[:2]
    kind = "with the shading of the photos" if asset.unlit else "without shading"
    out = [panel("Base colour", f"{width} × {height}, {kind}", encode(asset.base_color))]
    if asset.normal_map is not None:
        out.append(panel("Normal", "tangent space, +Y up", 0.5 + 0.5 * asset.normal_map))
    if asset.orm is not None:
        names = (("Ambient occlusion", "white = unoccluded"), ("Roughness", "white = rough"), ("Metallic", "white = metal"))
        for k, (title, caption) in enumerate(names):
            low, high = float(asset.orm[..., k].min()), float(asset.orm[..., k].max())
            span = f"constant {low:.2f}" if high - low < 0.004 else f"{caption}, {low:.2f}–{high:.2f}"
            out.append(panel(title, span, grey(asset.orm[..., k])))
    if asset.emissive is not None:
        out.append(panel("Emission", "emitted radiance", encode(asset.emissive)))
    charts = int(face_charts(asset.faces, len(asset.uv)).max()) + 1 if len(asset.faces) else 0
    out.append(panel("UV atlas", f"{charts} charts, {number(len(asset.faces))} triangles", uv_atlas_image(asset)))
    return tuple(out)


def missed_panel(asset: Asset, coverage: Path) -> tuple[Panel, ...]:
    """Where the rays of texels missed the dense mesh, by the bake's `coverage`: red on the grey base colour. Nothing where few did."""
    try:
        image = read_exr(coverage)
    except BadInputError:  # none, as for a file of the user's
        return ()
    (height, width), (rows, columns) = image.shape[:2], asset.base_color.shape[:2]
    if image.shape[2] < 4 or (rows % height, columns % width) != (0, 0):  # the base colour may be finer than the other maps
        return ()
    inside, missed = image[..., 0] > 0.5, (image[..., 0] > 0.5) & (image[..., 3] < 0.5)
    share = missed.sum() / max(inside.sum(), 1)
    if share < MIN_MISSED:
        return ()
    reduced = cv2.resize(encode(asset.base_color).mean(2), (width, height), interpolation=cv2.INTER_AREA)
    grey = np.repeat(reduced[..., None], 3, axis=2) * np.where(inside, 0.7, 0.3)[..., None]
    drawn = np.where(missed[..., None], np.array([0.9, 0.1, 0.1]), grey).astype(np.float32)
    caption = f"red: {share:.1%} of the texels, whose rays met no dense surface; they are flat"
    return (Panel("Missed rays", caption, image_uri(downsample(drawn))),)
