"""Errors of baked textures against the reference asset, per texel and without a renderer.

Every observed texel is compared with the nearest reference surface point: base colour as PSNR in dB of sRGB values after one gain
per channel (the light's intensity is not observable), roughness and metallic as root mean squares. The independent scorer compares renders
of the same textures and so weighs texels by their visibility; here all texels weigh the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from benchmarks.truth import Z_UP, align, nearest, nearest_on_faces, read_centres, read_mesh, read_truth
from gsbake.geometry.cameras import CameraSet
from gsbake.geometry.vectors import unit
from gsbake.imaging.exr import read_exr
from gsbake.imaging.srgb import decode, encode
from gsbake.texturing.texels import rasterise

Floats = NDArray[np.float64]

#: Texels compared, about.
MAX_TEXELS = 100_000
#: Bounds of the logarithm of the gain.
LOG_GAIN = (-1.5, 1.5)


@dataclass(frozen=True)
class MapErrors:
    """Base colour in dB (higher is better), roughness and metallic as root mean squares (0..1)."""

    texel_albedo_psnr: float
    texel_roughness_rmse: float
    texel_metallic_rmse: float


def measure_maps(bake: Path, mesh: Path, poses: Path, capture: Path) -> MapErrors:
    """The errors of a bake stage's textures, from the stage folders of its mesh and poses and the `capture` with the reference in `gt/`."""
    from safetensors.numpy import load_file

    unwrapped = load_file(bake / "mesh.safetensors")
    base, orm, coverage = (read_exr(bake / f"{name}.exr") for name in ("base_color", "orm", "coverage"))
    if len(base) > len(orm):  # the base colour alone may be finer
        base = np.asarray(cv2.resize(base, orm.shape[1::-1], interpolation=cv2.INTER_AREA))
    texels = rasterise(unwrapped["uv"], unwrapped["faces"], len(orm))
    observed = np.flatnonzero(coverage.reshape(-1, coverage.shape[-1])[texels.index, 1] > 0.5)
    chosen = observed[:: max(1, len(observed) // MAX_TEXELS)]
    baked = np.concatenate([base, orm[..., 1:]], 2).reshape(-1, 5)[texels.index[chosen]].astype(np.float64)
    points = texels.interpolate(unwrapped["position"], unwrapped["faces"])[chosen]
    reference = ReferencePoints.nearest_to(points, mesh, poses, capture).values()
    decibels = -10 * np.log10(np.mean([_min_error(baked[:, k], reference[:, k]) for k in range(3)]))
    roughness, metallic = np.sqrt(((baked[:, 3:] - reference[:, 3:]) ** 2).mean(0))
    return MapErrors(float(decibels), float(roughness), float(metallic))


@dataclass(frozen=True)
class ReferencePoints:
    """Points on the reference `asset` (trimesh, +Y up): the `face` (n,) and the barycentric `share` (n, 3) of each.

    `rotation` (3, 3) turns the run's unit frame into the truth's Z-up world.
    """

    asset: Any
    face: NDArray[np.int64]
    share: Floats
    rotation: Floats

    @classmethod
    def nearest_to(cls, points: NDArray[np.floating], mesh: Path, poses: Path, capture: Path) -> ReferencePoints:
        """Those of the reference in `capture` nearest to `points` (n, 3) in the unit frame of the run of stage folders `mesh`, `poses`."""
        import trimesh

        truth, cameras = read_truth(capture), CameraSet.load(poses / "cameras.json")
        to_truth = cameras.to_world
        if cameras.poses != "given":
            to_truth = to_truth.then(align(read_mesh(mesh / "mesh.ply").moved(to_truth), read_centres(poses / "cameras.json"), truth))
        at = to_truth.apply(np.asarray(points, np.float64))
        face = nearest(at, truth.surface, 3)[1]
        corners = truth.surface.corners[face]
        asset = trimesh.load(capture / "gt" / "asset.glb", force="mesh", process=False)
        return cls(asset, face, barycentric(corners, nearest_on_faces(at, corners)), to_truth.rotation)

    def values(self) -> Floats:
        """Linear base colour, roughness and metallic (n, 5)."""
        material = self.asset.visual.material
        packed = self._read(material.metallicRoughnessTexture)
        factors = [1.0 if f is None else f for f in (material.roughnessFactor, material.metallicFactor)]
        return np.column_stack([decode(self._read(material.baseColorTexture)), packed[:, 1:] * factors])

    def emission(self) -> Floats | None:
        """Linear emission (n, 3); None where the reference has none."""
        material = self.asset.visual.material
        if material.emissiveFactor is None or not np.any(material.emissiveFactor):
            return None
        return decode(self._read(material.emissiveTexture)) * np.asarray(material.emissiveFactor, np.float64)

    def normals(self) -> Floats:
        """Unit shading normals (n, 3) in the unit frame, with the reference's normal map; its tangents are those of the faces."""
        corner = np.asarray(self.asset.faces)[self.face]
        smooth = unit(self._at(np.asarray(self.asset.vertex_normals)))
        shaded = smooth
        if (image := getattr(getattr(self.asset.visual, "material", None), "normalTexture", None)) is not None:
            p, uv = np.asarray(self.asset.vertices)[corner], np.asarray(self.asset.visual.uv)[corner]
            (e1, e2), (d1, d2) = ((x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) for x in (p, uv))
            size = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
            along = unit((e1 * d2[:, 1:] - e2 * d1[:, 1:]) * np.sign(size)[:, None])
            along = unit(along - (along * smooth).sum(1, keepdims=True) * smooth)
            across = np.cross(smooth, along) * np.sign(size)[:, None]  # trimesh's v runs up, as the map's green does
            x, y, z = (2 * self._read(image) - 1).T[..., None]
            shaded = np.where(size[:, None] != 0, unit(x * along + y * across + z * smooth), smooth)
        return np.asarray(shaded @ Z_UP.T @ self.rotation)

    def _at(self, values: Floats) -> Floats:
        """Values (v, d) of the vertices at the points (n, d)."""
        return np.asarray(np.einsum("nk,nkd->nd", self.share, values[np.asarray(self.asset.faces)[self.face]]))

    def _read(self, image: Any) -> Floats:
        """A texture (0..1) at the points (n, 3); ones without it."""
        if image is None:
            return np.ones((len(self.face), 3))
        uv, pixels = self._at(np.asarray(self.asset.visual.uv)), np.asarray(image.convert("RGB"))
        height, width = pixels.shape[:2]
        # trimesh flips v: its origin is at the bottom.
        row, column = ((1 - uv[:, 1]) % 1 * height).astype(np.int64), (uv[:, 0] % 1 * width).astype(np.int64)
        return pixels[np.minimum(row, height - 1), np.minimum(column, width - 1)] / 255.0


def barycentric(corners: Floats, points: Floats) -> Floats:
    """Barycentric coordinates (n, 3) of `points` (n, 3) on triangles with `corners` (n, 3, 3)."""
    import trimesh

    share = np.clip(np.nan_to_num(trimesh.triangles.points_to_barycentric(corners, points, method="cramer"), nan=1 / 3), 0, 1)
    return np.asarray(share / share.sum(1, keepdims=True))


def _min_error(baked: Floats, reference: Floats) -> float:
    """Mean square of the differences of sRGB values (0..1) of two linear channels (n,), at the best gain on the first."""
    target = encode(reference)
    return float(minimize_scalar(lambda gain: ((encode(baked * np.exp(gain)) - target) ** 2).mean(), bounds=LOG_GAIN, method="bounded").fun)
