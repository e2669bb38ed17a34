"""Projected textures of an unwrapped mesh: colours from the photos, or materials from the trained surfels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.exposure import TiePointExposure
from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.photos.roles import held_out
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.geometry.cameras import Camera
from gsbake.imaging.srgb import decode_bytes
from gsbake.monitor import Monitor, Rule, decide_skip
from gsbake.surfels.renderer import SurfelRenderer
from gsbake.texturing.exposure_agreement import exposure_agreement
from gsbake.texturing.projection import ProjectedTexture, ProjectionBlender, mask_weights
from gsbake.texturing.skip_rules import believed_exposures, constant_exposure
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh
from gsbake.texturing.usable_pixels import UsablePixels
from gsbake.texturing.view_fusion import solve_gains

Floats = NDArray[np.float32]

#: Weight of held-out photos: they fill only what no other photo observed, so that validation figures stay unbiased.
HELD_OUT_WEIGHT = 1e-4
#: Within this share of a photo's longer side from the mask's boundary, pixels weigh less.
MASK_MARGIN = 0.008
#: The two outcomes of the rule on exposure.
CONSTANT, EQUALISED = "exposure taken as constant", "exposure equalised"
#: Least alpha of a surfel render whose materials are used.
MIN_ALPHA = 0.8


class PhotoProjector:
    """Reads photos at the size that a texture needs, with the weights of their pixels.

    `holdout` is that of training.
    """

    def __init__(self, photos: FullPhotos, holdout: int) -> None:
        self._photos = photos
        self._usable = UsablePixels(photos.posed)
        self._held_out = set(held_out(len(photos), holdout))

    def add(self, blender: ProjectionBlender, index: int) -> tuple[Camera, Floats]:
        """Add photo `index` to `blender`; returns its camera and linear colours (h, w, 3)."""
        working = self._photos.posed.cameras.cameras[index]
        size = blender.useful_size(self._photos.camera(index))
        view = self._photos.view(index, max(size, working.width, working.height))
        linear = decode_bytes(view.rgb)
        mask = self._usable.mask(index, view)
        weights = None if mask is None else mask_weights(mask, MASK_MARGIN * max(view.camera.width, view.camera.height))
        blender.add(view.camera, linear, weights, HELD_OUT_WEIGHT if index in self._held_out else 1.0)
        return view.camera, linear


def project_photos(surface: UnwrappedMesh, photos: FullPhotos, holdout: int, equalisation: Rule, monitor: Monitor) -> ProjectedTexture:
    """Linear colours (n, 3) of the texels, fused from the photos, each at a size at which its pixels are as fine as texels.

    `holdout` is that of training. `equalisation` is the rule of [skip] for dividing out exposure gains.
    """
    posed = photos.posed
    blender = ProjectionBlender(surface.texel_position, surface.texel_normal, surface.caster, 3, surface.texel_size)
    reader, measured = PhotoProjector(photos, holdout), equalisation != "skip"
    tie_points = TiePointExposure.from_model(posed.folder / "sparse", posed.cameras.to_world.inverse()) if measured else None
    for index in range(len(posed)):
        monitor.check_stop()
        camera, linear = reader.add(blender, index)
        if tie_points is not None:
            tie_points.add(camera, linear)
        monitor.progress(index + 1, len(posed), "projection")
    if not measured:
        decide_skip(monitor, "exposure_equalisation", equalisation, True, "not measured", CONSTANT, EQUALISED)
        return blender.result()
    spread = None if tie_points is None else tie_points.spread()
    known = photos.written_exposures()
    return blender.result(_exposure_gains(blender, surface, posed.cameras.cameras, known, spread, equalisation, monitor))


def _exposure_gains(
    blender: ProjectionBlender,
    surface: UnwrappedMesh,
    cameras: Sequence[Camera],
    written: NDArray[np.float64] | None,
    spread: float | None,
    rule: Rule,
    monitor: Monitor,
) -> Floats | None:
    """Gains (photos, 3) of the photos in `blender`, None where all have one exposure; `written` are logarithms (photos,) of those by EXIF,
    `spread` is that at tie points."""
    logs, view, texel = blender.log_samples()
    known, said = believed_exposures(written, logs, view, monitor)
    gains = np.ones((len(cameras), 3), np.float32)
    if known is not None:
        gains *= np.exp(known)[:, None].astype(np.float32)
        logs = logs - known[view][..., None]
    centres = np.stack([camera.centre for camera in cameras])
    agreement = exposure_agreement(logs.mean(2), view, surface.texel_position[texel], surface.texel_normal[texel], centres)
    constant, evidence = constant_exposure(agreement, len(cameras), spread, said)
    if decide_skip(monitor, "exposure_equalisation", rule, constant and known is None, evidence, CONSTANT, EQUALISED):
        return None
    return gains if constant and known is not None else gains * solve_gains(logs, view, len(cameras))


def project_surfel_materials(surface: UnwrappedMesh, posed: PosedPhotos, trained: Path, size: int, monitor: Monitor) -> ProjectedTexture:
    """Base colour, roughness, metallic (n, 5) of the texels, from the surfels of the folder `trained` rendered at the photos' poses.

    `size` is the longer side of the renders in pixels.
    """
    renderer = SurfelRenderer.load(trained)
    blender = ProjectionBlender(surface.texel_position, surface.texel_normal, surface.caster, 5, surface.texel_size)
    for index, full in enumerate(posed.cameras.cameras):
        monitor.check_stop()
        camera = full.downscaled_to(size)
        buffers = renderer.gbuffer(camera)
        image = np.dstack([buffers["albedo"], buffers["roughness"], buffers["metallic"]])
        solid = (buffers["alpha"] > MIN_ALPHA).astype(np.uint8) * 255
        blender.add(camera, image, mask_weights(solid, MASK_MARGIN * size))
        monitor.progress(index + 1, len(posed), "projection")
    return blender.result()
