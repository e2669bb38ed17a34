"""Pixels to take colours from: without the background that loose masks hold, and without black that other programs leave at the frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos, View
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.png import write_png
from gsbake.texturing.projection import ProjectionBlender, mask_weights
from gsbake.texturing.usable_pixels import UsablePixels, background_band
from tests.texturing.test_projection import SIZE, camera, directions, photo, points, sphere, texture

__all__ = ["sphere"]  # the fixture

Bytes = NDArray[np.uint8]


def disc(radius: float) -> NDArray[np.bool_]:
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    return np.hypot(x - SIZE / 2, y - SIZE / 2) < radius


def grown(mask: NDArray[np.bool_], pixels: int) -> Bytes:
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(255 * (away <= pixels), np.uint8)


def test_background_inside_a_loose_mask_is_found() -> None:
    """Two pixels of black around a bright disc; a tight mask loses nothing, nor an object of the background's colour its middle."""
    object_, rgb = disc(50), np.zeros((SIZE, SIZE, 3), np.uint8)
    rgb[object_] = (90, 120, 60)
    loose = grown(object_, 2)
    band = background_band(rgb, loose)
    assert band[(loose > 0) & ~object_].all() and not band[disc(47)].any()
    assert not background_band(rgb, 255 * object_.astype(np.uint8)).any()
    assert not background_band(np.full_like(rgb, 9), loose)[disc(44)].any()


def test_an_uneven_background_is_compared_with_what_lies_beside() -> None:
    object_ = disc(50)
    rgb = np.repeat(np.tile(np.linspace(60, 200, SIZE).astype(np.uint8), (SIZE, 1))[..., None], 3, 2)
    rgb[object_] = (250, 20, 20)
    loose = grown(object_, 2)
    assert background_band(rgb, loose)[(loose > 0) & ~object_].mean() > 0.95


def test_thin_parts_keep_their_pixels() -> None:
    mask, rgb = np.zeros((SIZE, SIZE), np.uint8), np.zeros((SIZE, SIZE, 3), np.uint8)
    mask[78:82, 20:140] = 255
    rgb[78:82, 20:140] = 3
    assert not background_band(rgb, mask).any()


def posed(folder: Path, photos: list[Bytes], masks: list[Bytes] | None = None) -> PosedPhotos:
    """Posed photos of the unit sphere from all sides."""
    cameras = tuple(camera(d, f"p{k}") for k, d in enumerate(directions(len(photos))))
    for sub, images in (("photos", photos), ("masks", masks or [])):
        (folder / sub).mkdir(parents=True)
        for k, image in enumerate(images):
            write_png(folder / sub / f"p{k}.png", image)
    CameraSet(cameras).save(folder / "cameras.json")
    return PosedPhotos.open(folder)


def corners() -> NDArray[np.bool_]:
    """What programs that undistort photos leave without a picture: four corners."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    return np.hypot(x - SIZE / 2, y - SIZE / 2) > 0.62 * SIZE


def test_black_that_all_photos_show_at_the_frame(tmp_path: Path) -> None:
    """A black spot at the frame of one photo, black inside the picture, and black before which an object with a mask stands are no such."""
    photos = []
    for k in range(4):
        rgb = np.random.default_rng(k).integers(40, 200, (SIZE, SIZE, 3), np.uint8)
        rgb[corners()] = 2
        rgb[70:90, 70:90] = 0
        rgb[:20, 40 + 20 * k : 60 + 20 * k] = 0
        photos.append(rgb)
    found = posed(tmp_path / "a", photos)
    masks = [UsablePixels(found).mask(k, found.view(k)) for k in range(4)]
    for mask in masks:
        assert mask is not None and not mask[corners()].any() and mask[70:90, 70:90].all() and mask[:20, 44:116].all()
    small = UsablePixels(found).mask(0, found.view(0, SIZE // 2))
    assert small is not None and small.shape == (SIZE // 2, SIZE // 2) and not small[0, 0] and small[40, 40]
    few = posed(tmp_path / "b", photos[:2])
    assert UsablePixels(few).mask(0, few.view(0)) is None
    dark = [np.where(disc(40)[..., None], 3, 0).astype(np.uint8) for _ in range(4)]
    given = posed(tmp_path / "c", dark, [255 * disc(40).astype(np.uint8)] * 4)
    tight = UsablePixels(given).mask(0, given.view(0))
    assert tight is not None and tight[disc(34)].all()


def test_loose_masks_leave_no_background_in_the_texture(tmp_path: Path, sphere: RayCaster) -> None:
    """A sphere whose mesh is too large by what its masks are: texels at the silhouette see the background, if nothing says that they do."""
    views = [camera(d, f"p{k}") for k, d in enumerate(directions(6))]
    photos, masks = [], []
    for view in views:
        linear = photo(view)
        outside = linear[..., 2] == 1
        linear[outside] = 0
        photos.append(np.asarray(np.rint(linear * 255), np.uint8))
        masks.append(grown(~outside, 2))
    found = posed(tmp_path, photos, masks)
    p = points()
    larger = RayCaster(1.03 * sphere.vertices, sphere.faces)
    found_dark = {}
    for name in ("loose", "usable"):
        blender, usable = ProjectionBlender(1.03 * p, p, larger, 3, 0.02), UsablePixels(found)
        for k in range(len(views)):
            view: View = found.view(k)
            mask = view.mask if name == "loose" else usable.mask(k, view)
            assert mask is not None
            blender.add(view.camera, view.rgb.astype(np.float32) / 255, mask_weights(mask, 2))
        result = blender.result()
        dark = result.values[result.observed].min(1) < 0.16
        found_dark[name] = int(dark.sum()), float(result.observed.mean())
    assert texture(p).min() > 0.19  # the object is nowhere dark
    assert found_dark["loose"][0] > 20 and found_dark["usable"][0] == 0 and found_dark["usable"][1] > 0.95, found_dark
