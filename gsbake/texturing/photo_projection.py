"""Projected textures of an unwrapped mesh: colours from the photos, or materials from the trained surfels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsbake.capture.exposure import TiePointExposure
from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.photos.roles import held_out
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.imaging.srgb import decode_bytes
from gsbake.monitor import Monitor, Rule, decide_skip
from gsbake.surfels.renderer import SurfelRenderer
from gsbake.texturing.projection import ProjectedTexture, ProjectionBlender, mask_weights
from gsbake.texturing.skip_rules import constant_exposure
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh
from gsbake.texturing.usable_pixels import UsablePixels

#: Weight of held-out photos: they fill only what no other photo observed, so that validation figures stay unbiased.
HELD_OUT_WEIGHT = 1e-4
#: Within this share of a photo's longer side from the mask's boundary, pixels weigh less.
MASK_MARGIN = 0.008
#: Least alpha of a surfel render whose materials are used.
MIN_ALPHA = 0.8


def project_photos(surface: UnwrappedMesh, photos: FullPhotos, holdout: int, equalisation: Rule, monitor: Monitor) -> ProjectedTexture:
    """Linear colours (n, 3) of the texels, fused from the photos, each at a size at which its pixels are as fine as texels.

    `holdout` is that of training. `equalisation` is the rule of [skip] for dividing out exposure gains.
    """
    posed = photos.posed
    held_out_views = set(held_out(len(posed), holdout))
    blender = ProjectionBlender(surface.texel_position, surface.texel_normal, surface.caster, 3, surface.texel_size)
    usable, measured = UsablePixels(posed), equalisation != "skip"
    tie_points = TiePointExposure.from_model(posed.folder / "sparse", posed.cameras.to_world.inverse()) if measured else None
    for index in range(len(posed)):
        monitor.check_stop()
        working = posed.cameras.cameras[index]
        size = blender.useful_size(photos.camera(index))
        view = photos.view(index, max(size, working.width, working.height))
        linear = decode_bytes(view.rgb)
        if tie_points is not None:
            tie_points.add(view.camera, linear)
        mask = usable.mask(index, view)
        weights = None if mask is None else mask_weights(mask, MASK_MARGIN * max(view.camera.width, view.camera.height))
        blender.add(view.camera, linear, weights, HELD_OUT_WEIGHT if index in held_out_views else 1.0)
        monitor.progress(index + 1, len(posed), "projection")
    projected = blender.result(solve_exposure=measured)
    constant, evidence = True, "not measured"
    if measured:
        constant, evidence = constant_exposure(projected.gains, projected.explained, None if tie_points is None else tie_points.spread())
    skipped, done = "exposure taken as constant", "exposure equalised"
    if decide_skip(monitor, "exposure_equalisation", equalisation, constant, evidence, skipped, done) and (projected.gains != 1).any():
        projected = blender.result()
    return projected


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
