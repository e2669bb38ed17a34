"""Masks of an object on a plane with texture: what the plane explains is not the object.

Under true cameras a plane maps one photo to another by a homography. Pixels that other photos confirm through it show the plane; what
stands on it is displaced (plane and parallax: Irani & Anandan, *A unified approach to moving object detection in 2D and 3D scenes*, PAMI
1998). A point in space is free where photos see the plane behind it, so these pixels carve the object's hull, whatever its colour, gloss
or shape. The hull is some pixels too large; colour finds the border (GrabCut: Rother et al., SIGGRAPH 2004). Networks that guess masks from
single photos fail where this does not, and the other way round: mirror-like metal shows its surroundings, a plain table confirms nothing.
A flat foot hardly rises above the plane, so that the plane explains it too. A second set of masks lets colour decide straight below the
object as well; there a shadow may join it, so the set is used that agrees better between photos.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.masks.completion import disc, render_cells
from gsbake.capture.masks.consensus import MIN_TRUSTED_OVERLAP, distorted, intersection_over_union, small_views
from gsbake.capture.poses.normalisation import frame_radius, nearest_point_to_axes
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Array, Camera
from gsbake.imaging.correlation import Floats, Windows, window_mean
from gsbake.imaging.png import read_grey, write_png

Mask = NDArray[np.bool_]

#: RANSAC's hypotheses, tolerance of an inlier as a share of the cameras' distance, and share of the tie points that lie on the plane. With
#: fewer there, stereo sees the object (fox), which masks with a ragged border do not improve.
HYPOTHESES, PLANE_TOLERANCE, MIN_PLANE_SHARE = 500, 0.006, 0.6
#: Share of the tie points that may lie below it, and most points that are tried.
MAX_BELOW_SHARE, MAX_POINTS = 0.05, 4000
#: Photos that confirm a pixel: their number, and the angles in degrees between the directions from which they look.
PARTNERS, MIN_ANGLE, MAX_ANGLE = 10, 12.0, 60.0
#: Window of the correlation in pixels of the small photos, correlation from which it is the same, and contrast (grey levels) that it needs.
WINDOW, SAME_WINDOW, MIN_CONTRAST = 7, 0.7, 4.0
#: Photos that must compare a pixel, and share of them that must confirm it.
MIN_COMPARED, MIN_CONFIRMED_SHARE = 3, 0.4
#: A cell is the object's where at most this share of the photos that decide see the plane behind it, at least that share of those that show
#: it decide, and this share of all show it.
MAX_FREE_SHARE, MIN_DECIDED_SHARE, MIN_VISIBLE_SHARE = 0.1, 0.25, 0.5
#: Cells along an edge in the first and the second pass, and half edge of the first cube in radii of the frame.
CELLS, FIRST_RADIUS = (40, 72), 1.3
#: Radius in cells that closes gaps in silhouettes, and in those of a single layer of cells.
CLOSING, FLAT_CLOSING = 0.7, 1.5
#: Share of a photo's border that the object covers at most, in the median: masks of everything agree with each other too.
MAX_BORDER_SHARE = 0.4
#: Longer side in pixels of the photos that are segmented, GrabCut's iterations, and guess that is taken as certain inside the hull.
SEGMENT_SIZE, ITERATIONS, CERTAIN = 384, 4, 200
#: Band around the silhouette that may be the object's too, as a share of the root of its area; holes of less than this share are filled.
BAND, MAX_HOLE = 0.025, 0.005


@dataclass(frozen=True)
class Plane:
    """n·x = `offset` with the unit `normal` (3,) towards the cameras, world frame."""

    normal: Array
    offset: float


def find_plane(points: Array, cameras: Sequence[Camera], seed: int) -> Plane | None:
    """The plane on which most tie points (n, 3) lie, before the cameras and with hardly a point behind it; None where there is none."""
    focus, centres = nearest_point_to_axes(cameras), np.stack([c.centre for c in cameras])
    reach = float(np.median(np.linalg.norm(centres - focus, axis=1)))
    near = points[np.linalg.norm(points - focus, axis=1) < reach]
    near = near[:: -(-len(near) // MAX_POINTS) or 1]
    if len(near) < 50:
        return None
    rng, tolerance = np.random.default_rng(seed), PLANE_TOLERANCE * reach
    corners = near[rng.integers(0, len(near), (HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-9 * reach**2
    normals, corners = normals[usable] / lengths[usable, None], corners[usable]
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    counts = (np.abs(near @ normals.T - offsets) < tolerance).sum(0)
    counts[~(np.abs(np.sign(centres @ normals.T - offsets).sum(0)) == len(centres))] = 0
    if not len(counts) or counts.max() < MIN_PLANE_SHARE * len(near):
        return None
    best = int(counts.argmax())
    inliers = near[np.abs(near @ normals[best] - offsets[best]) < tolerance]
    normal = np.linalg.svd(inliers - inliers.mean(0), full_matrices=False)[2][2]
    offset = float(normal @ inliers.mean(0))
    if np.median(centres @ normal) < offset:
        normal, offset = -normal, -offset
    below = float((near @ normal < offset - 3 * tolerance).mean())
    return Plane(normal, offset) if below <= MAX_BELOW_SHARE else None


@dataclass(frozen=True)
class StandingObject:
    """Per photo the pixels (h, w) of an object on a plane, and of the plane straight below it."""

    silhouettes: list[Mask]
    below: list[Mask]


def plane_masks(
    cameras: Sequence[Camera], photos: Mapping[str, Path], guesses: Mapping[str, Path], points: Array, out: Path, seed: int, threads: int
) -> list[dict[str, Path]]:
    """Write masks of what stands on the support plane into folders in `out`; files by photo name. Empty where there is no plane or object.

    There are two sets of masks: in the second one colour decides on the plane straight below the object too. `cameras` (world frame) may
    be distorted; `photos` and `guesses` are files by name, `points` (n, 3) are tie points. Guesses that overlap what is found complete it.
    Masks have SEGMENT_SIZE and show what the photos show.
    """
    plane = find_plane(points, cameras, seed)
    if plane is None:
        return []
    try:
        pinholes, images = small_views(cameras, photos)
    except BadInputError:
        return []
    decided = confirmed_pixels(pinholes, [image.astype(np.float32) for image in images], plane)
    found = find_object(pinholes, decided, plane)
    if found is None:
        return []
    folders = [out / "above", out / "below"]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)

    def write(item: tuple[Camera, Mask, Mask]) -> list[Path]:
        camera, silhouette, below = item
        photo: Any = cv2.imread(str(photos[camera.name]), cv2.IMREAD_COLOR)
        if photo is None:
            raise FileNotFoundError(photos[camera.name])
        small = camera.downscaled_to(SEGMENT_SIZE)
        size = small.width, small.height
        photo, guess = (cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (photo, read_grey(guesses[camera.name])))
        shape, under = (
            cv2.resize(distorted(i, camera).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for i in (silhouette, below)
        )
        paths = []
        for folder, possible in zip(folders, (np.zeros_like(under), under), strict=True):
            mask = segment(photo, shape, guess > CERTAIN, possible)
            if intersection_over_union(mask, guess > 127) >= MIN_TRUSTED_OVERLAP:
                mask = mask | (guess > 127)
            paths.append(folder / f"{camera.name}.png")
            write_png(paths[-1], 255 * mask.astype(np.uint8))
        return paths

    with ThreadPoolExecutor(max(1, threads)) as pool:
        paths = list(pool.map(write, zip(cameras, found.silhouettes, found.below, strict=True)))
    return [dict(zip([c.name for c in cameras], files, strict=True)) for files in zip(*paths, strict=True)]


def confirmed_pixels(cameras: Sequence[Camera], images: Sequence[Floats], plane: Plane) -> list[tuple[Mask, Mask]]:
    """For each photo the pixels (h, w) that others could confirm as the plane, and those that they do; `images` are grey levels."""
    focus = nearest_point_to_axes(cameras)
    directions = np.stack([focus - camera.centre for camera in cameras])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    found = []
    for i, image in enumerate(images):
        points, hit = _on_plane(cameras[i], plane)
        partners = [j for j in np.argsort(angles[i], kind="stable") if MIN_ANGLE < angles[i, j] < MAX_ANGLE][:PARTNERS]
        photo = Windows.of(image, WINDOW)
        compared, confirmed = np.zeros(image.shape, np.float32), np.zeros(image.shape, np.float32)
        for j in partners:
            pixel, depth = cameras[j].project(points.reshape(-1, 3))
            inside = hit & cameras[j].in_view(pixel, depth).reshape(image.shape)
            columns, rows = (np.ascontiguousarray(pixel[:, k].reshape(image.shape) - 0.5, np.float32) for k in (0, 1))
            warped = np.asarray(cv2.remap(images[j], columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
            other = Windows.of(warped, WINDOW)
            comparable = (window_mean(inside.astype(np.float32), WINDOW) > 0.999) & (photo.contrast(other) >= MIN_CONTRAST)
            compared += comparable
            confirmed += comparable & photo.correlate(other, SAME_WINDOW)
        decided = compared >= MIN_COMPARED
        found.append((decided, decided & (confirmed >= MIN_CONFIRMED_SHARE * compared)))
    return found


def find_object(cameras: Sequence[Camera], pixels: Sequence[tuple[Mask, Mask]], plane: Plane) -> StandingObject | None:
    """The largest part of space above the plane behind which photos do not see it; None where nothing is left, or nothing stands alone
    there. `pixels` as from `confirmed_pixels`."""
    low = nearest_point_to_axes(cameras)
    half = FIRST_RADIUS * float(np.median([min(frame_radius(c, low), np.linalg.norm(c.centre - low)) for c in cameras]))
    low, edge = low - half, np.full(3, 2 * half)
    cells = np.zeros((0, 3))
    cell = 0.0
    for count in CELLS:
        cell = float(edge.max()) / count
        shape = np.maximum(1, np.ceil(edge / cell).astype(int))
        grid = low + (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) + 0.5) * cell
        solid = _is_object(grid.reshape(-1, 3), cameras, pixels, plane, 0.5 * cell).reshape(shape)
        label, parts = ndimage.label(solid)
        if not parts:
            return None
        solid = label == 1 + int(np.argmax(ndimage.sum_labels(solid, label, np.arange(1, parts + 1))))
        cells = grid[solid]
        low, high = cells.min(0) - 2 * cell, cells.max(0) + 2 * cell
        edge = high - low
    silhouettes = [render_cells(cells, cell, camera, CLOSING) for camera in cameras]
    border = [np.concatenate([s[0], s[-1], s[:, 0], s[:, -1]]).mean() for s in silhouettes]
    if np.median(border) > MAX_BORDER_SHARE:
        return None
    projection = cells - (cells @ plane.normal - plane.offset)[:, None] * plane.normal
    below = [cv2.dilate(render_cells(projection, cell, camera, FLAT_CLOSING).astype(np.uint8), disc(1)) > 0 for camera in cameras]
    return StandingObject(silhouettes, below)


def segment(photo: NDArray[np.uint8], silhouette: Mask, certain: Mask, possible: Mask) -> Mask:
    """The object (h, w) in a photo (h, w, 3) by colour: in and around the `silhouette`, including what is `certain` there, and where it is
    `possible`."""
    if not silhouette.any() or silhouette.all():
        return silhouette
    radius = max(2, round(BAND * float(np.sqrt(np.count_nonzero(silhouette)))))
    outer = cv2.dilate(silhouette.astype(np.uint8), disc(radius)) > 0
    labels = np.full(silhouette.shape, cv2.GC_BGD, np.uint8)
    labels[outer | possible] = cv2.GC_PR_BGD
    labels[silhouette | (outer & certain)] = cv2.GC_PR_FGD
    labels[silhouette & certain] = cv2.GC_FGD
    cv2.setRNGSeed(0)  # of its k-means
    cv2.grabCut(photo, labels, (0, 0, 1, 1), np.zeros((1, 65)), np.zeros((1, 65)), ITERATIONS, cv2.GC_INIT_WITH_MASK)
    found = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    label, _ = ndimage.label(~found)
    small = np.bincount(label.ravel()) < MAX_HOLE * np.count_nonzero(found)
    return np.asarray(found | (small[label] & silhouette))


def _on_plane(camera: Camera, plane: Plane) -> tuple[Array, Mask]:
    """Points (h, w, 3) of the plane that pixels show, and where they do."""
    rays = camera.rays()
    towards = rays @ plane.normal
    depth = (plane.offset - plane.normal @ camera.centre) / np.where(np.abs(towards) < 1e-9, 1e-9, towards)
    hit = (towards < -1e-3) & (depth > 0)
    return camera.centre + np.where(hit, depth, 0.0)[..., None] * rays, hit


def _is_object(
    points: Array, cameras: Sequence[Camera], pixels: Sequence[tuple[Mask, Mask]], plane: Plane, clearance: float
) -> Mask:
    """Whether points (n, 3) are the object's by the photos' votes."""
    above = np.flatnonzero(points @ plane.normal - plane.offset > clearance)
    shown, decided, free = (np.zeros(len(above), np.int32) for _ in range(3))
    for camera, (known, confirmed) in zip(cameras, pixels, strict=True):
        pixel, depth = camera.project(points[above])
        visible = np.flatnonzero(camera.in_view(pixel, depth))
        column, row = np.floor(pixel[visible]).astype(np.int64).T
        shown[visible] += 1
        decided[visible] += known[row, column]
        free[visible] += confirmed[row, column]
    solid = np.zeros(len(points), bool)
    solid[above] = (shown >= MIN_VISIBLE_SHARE * len(cameras)) & (free <= MAX_FREE_SHARE * decided) & (decided >= MIN_DECIDED_SHARE * shown)
    return solid
