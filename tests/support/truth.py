"""Errors of a baked asset against the analytic object of the built-in capture: shape, materials, and relighting.

The measurement is independent of the bake: ground truth is the analytic field with its materials, and relighting uses the analytic scene's
reference renderer (`gsbake.synth.shade`), which shares no code with the split sum of the material fit. Shadows are those of the true
object; normals, materials and the silhouette are the asset's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.truth import measure_file
from gsbake.geometry.cameras import Camera
from gsbake.imaging.metrics import decibels
from gsbake.imaging.sampling import bilinear
from gsbake.imaging.srgb import encode
from gsbake.report.asset import open_asset
from gsbake.report.render import Asset, Renderer, Samples
from gsbake.synth import scene
from gsbake.synth.capture import cameras
from gsbake.synth.shade import SAMPLE_SUBSETS, LightRig, make_light_rig, outgoing_radiance, render

#: glTF (+Y up) to the capture's Z-up world.
TO_WORLD = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
#: Points at which materials are compared.
POINTS = 20_000
#: Number and size in pixels of the relit images.
VIEWS, SIZE = 4, 96


@dataclass(frozen=True)
class Figures:
    """Chamfer distance in % of the diagonal, mean angle of the faces' normals in degrees, PSNR in dB of base colour (sRGB, one gain per
    channel) and of the asset in another light, root mean square errors of roughness and metallic."""

    chamfer: float
    normals: float
    base_color: float
    roughness: float
    metallic: float
    relit: float


def measure(asset: Path, capture: Path) -> Figures:
    """The figures of a GLB baked from the built-in capture."""
    shape = measure_file(asset, capture)
    drawn = in_world(open_asset(asset))
    found, true = _materials(drawn)
    gain = (true[:, :3] * found[:, :3]).sum(0) / (found[:, :3] ** 2).sum(0)
    colour = encode(found[:, :3] * gain) - encode(true[:, :3])
    error = np.sqrt(((found - true) ** 2).mean(0))
    return Figures(
        chamfer=shape.chamfer_pct,
        normals=shape.normal_deg,
        base_color=decibels(float((colour**2).mean())),
        roughness=float(error[3]),
        metallic=float(error[4]),
        relit=relit_psnr(drawn),
    )


def in_world(asset: Asset) -> Asset:
    """The asset of a GLB in the capture's Z-up world."""
    tangent = asset.tangent
    if tangent is not None:
        tangent = np.column_stack([tangent[:, :3] @ TO_WORLD.T, tangent[:, 3]]).astype(np.float32)
    normal = (asset.normal @ TO_WORLD.T).astype(np.float32)
    return replace(asset, position=asset.position @ TO_WORLD.T, normal=normal, tangent=tangent)


def onto_surface(points: np.ndarray) -> np.ndarray:
    """Points (n, 3) moved along the field's gradient to the true surface."""
    for _ in range(3):
        points = points - scene.distances(points)[:, None] * scene.normals(points)
    return points


def _materials(asset: Asset) -> tuple[np.ndarray, np.ndarray]:
    """Linear base colour, roughness, metallic (n, 5) of the asset at random points, and the truth nearest to them."""
    draw = np.random.default_rng(1)
    corner = asset.position[asset.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    face = draw.choice(len(asset.faces), POINTS, p=area / area.sum())
    u, v = np.sqrt(draw.random(POINTS)), draw.random(POINTS)
    weight = np.stack([1 - u, u * (1 - v), u * v], 1)
    uv = np.einsum("nk,nkc->nc", weight, asset.uv[asset.faces[face]]).astype(np.float32)
    orm = np.array([[[1, 1, 0]]], np.float32) if asset.orm is None else asset.orm
    base, packed = bilinear(asset.base_color, uv), bilinear(orm, uv)
    place = onto_surface(np.einsum("nk,nkc->nc", weight, corner[face]))
    return np.column_stack([base, packed[:, 1:]]), scene.materials(place)


def other_light() -> LightRig:
    """Lighting of no photo: a strong sun from behind as key, a dimmer and warmer sky."""
    return make_light_rig(sun=(2.4, 2.2, 1.8), ambient=(0.35, 0.30, 0.26), gradient=(-0.10, 0.05, 0.20), sun_direction=(-0.9, -0.6, 0.7))


def relit_psnr(asset: Asset) -> float:
    """PSNR (dB, sRGB values, one gain per channel and image) of the asset in the world frame against the truth in `other_light`."""
    rig = other_light()
    renderer = Renderer(asset)
    scores = []
    for camera in cameras(VIEWS, SIZE, seed=7):
        truth, cover = true_image(camera, rig)
        picture = renderer.draw(camera, lambda samples: under_rig(samples, rig))
        shown = np.asarray(picture.linear, np.float64)
        where = (cover > 0.5) | (picture.alpha > 0.5)
        mine, theirs = shown * picture.alpha[..., None], truth
        gain = (mine[where] * theirs[where]).sum(0) / np.maximum((mine[where] ** 2).sum(0), 1e-12)
        error = encode(mine * gain) - encode(theirs)
        scores.append(decibels(float((error[where] ** 2).mean())))
    return float(np.mean(scores))


def true_image(camera: Camera, rig: LightRig) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (h, w, 3) of the true object over black, and its coverage (h, w)."""
    picture, _ = render(
        camera.R, camera.centre, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, rig, False, scene.NO_MARKER
    )  # fmt: skip
    return picture[..., :3], picture[..., 3]


def under_rig(samples: Samples, rig: LightRig) -> np.ndarray:
    """Radiance (n, 3) of the asset's samples under a light rig, with the shadows of the true object."""
    place = onto_surface(np.asarray(samples.position, np.float64))
    out = np.zeros((len(place), 3), np.float32)
    for k in range(len(place)):
        normal, view = tuple(map(float, samples.normal[k])), tuple(map(float, samples.view[k]))
        surface = (*map(float, samples.base_color[k]), max(0.05, float(samples.roughness[k])), float(samples.metallic[k]))
        out[k] = outgoing_radiance(tuple(map(float, place[k])), normal, view, surface, rig, k % SAMPLE_SUBSETS)
    return out
