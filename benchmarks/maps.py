"""Errors of baked textures against the reference asset, per texel and without a renderer.

Every observed texel is compared with the nearest reference surface point: base colour as PSNR in dB of sRGB values after one gain
per channel (the light's intensity is not observable), roughness and metallic as root mean squares. The independent scorer compares renders
of the same textures and so weighs texels by their visibility; here all texels weigh the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from benchmarks.truth import Z_UP, align, nearest, nearest_on_faces, read_centres, read_mesh, read_truth
from gsbake.geometry.cameras import CameraSet, Similarity
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
    texels = rasterise(unwrapped["uv"], unwrapped["faces"], len(base))
    observed = np.flatnonzero(coverage.reshape(-1, 3)[texels.index, 1] > 0.5)
    chosen = observed[:: max(1, len(observed) // MAX_TEXELS)]
    baked = np.concatenate([base, orm[..., 1:]], 2).reshape(-1, 5)[texels.index[chosen]].astype(np.float64)
    reference = true_values(texels.interpolate(unwrapped["position"], unwrapped["faces"])[chosen], mesh, poses, capture)
    decibels = -10 * np.log10(np.mean([_min_error(baked[:, k], reference[:, k]) for k in range(3)]))
    roughness, metallic = np.sqrt(((baked[:, 3:] - reference[:, 3:]) ** 2).mean(0))
    return MapErrors(float(decibels), float(roughness), float(metallic))


def true_values(points: NDArray[np.floating], mesh: Path, poses: Path, capture: Path) -> Floats:
    """Linear base colour, roughness and metallic (n, 5) of the reference in `capture` nearest to `points` (n, 3) in the unit frame.

    `mesh` and `poses` are the stage folders of the run.
    """
    _, face, at, corners = _nearest_reference(points, mesh, poses, capture)
    return _true_values(capture / "gt" / "asset.glb", face, at, corners)


def true_normals(points: NDArray[np.floating], mesh: Path, poses: Path, capture: Path) -> Floats:
    """Unit shading normals (n, 3) in the unit frame of the reference nearest to `points` (n, 3), without its normal map."""
    import trimesh

    to_truth, face, at, corners = _nearest_reference(points, mesh, poses, capture)
    share = _barycentric(corners, at)
    asset: Any = trimesh.load(capture / "gt" / "asset.glb", force="mesh", process=False)
    normals = np.asarray(asset.vertex_normals) @ Z_UP.T @ to_truth.rotation
    return unit(np.einsum("nk,nkd->nd", share, normals[np.asarray(asset.faces)[face]]))


def _nearest_reference(
    points: NDArray[np.floating], mesh: Path, poses: Path, capture: Path
) -> tuple[Similarity, NDArray[np.int64], Floats, Floats]:
    """From the unit frame to the truth's Z-up world; there the face (n,) of the reference nearest to each of `points`, the nearest point
    (n, 3) on it and its corners (n, 3, 3)."""
    truth, cameras = read_truth(capture), CameraSet.load(poses / "cameras.json")
    to_truth = cameras.to_world
    if cameras.poses != "given":
        to_truth = to_truth.then(align(read_mesh(mesh / "mesh.ply").moved(to_truth), read_centres(poses / "cameras.json"), truth))
    at = to_truth.apply(np.asarray(points, np.float64))
    face = nearest(at, truth.surface, 3)[1]
    corners = truth.surface.corners[face]
    return to_truth, face, nearest_on_faces(at, corners), corners


def _barycentric(corners: Floats, points: Floats) -> Floats:
    """Barycentric coordinates (n, 3) of `points` (n, 3) on triangles with `corners` (n, 3, 3)."""
    import trimesh

    share = np.clip(np.nan_to_num(trimesh.triangles.points_to_barycentric(corners, points, method="cramer"), nan=1 / 3), 0, 1)
    return np.asarray(share / share.sum(1, keepdims=True))


def _true_values(asset: Path, face: NDArray[np.int64], points: Floats, corners: Floats) -> Floats:
    """Linear base colour, roughness and metallic (n, 5) of the true asset at `points` (n, 3) on its faces (n,) with `corners` (n, 3, 3)."""
    import trimesh

    mesh: Any = trimesh.load(asset, force="mesh", process=False)
    share = _barycentric(corners, points)
    uv = np.einsum("nk,nkd->nd", share, np.asarray(mesh.visual.uv)[np.asarray(mesh.faces)[face]])
    material = mesh.visual.material

    def read(image: Any) -> Floats:
        if image is None:
            return np.ones((len(uv), 3))
        pixels = np.asarray(image.convert("RGB"))
        height, width = pixels.shape[:2]
        # trimesh flips v: its origin is at the bottom.
        row, column = ((1 - uv[:, 1]) % 1 * height).astype(np.int64), (uv[:, 0] % 1 * width).astype(np.int64)
        return pixels[np.minimum(row, height - 1), np.minimum(column, width - 1)] / 255.0

    packed = read(material.metallicRoughnessTexture)
    factors = [1.0 if f is None else f for f in (material.roughnessFactor, material.metallicFactor)]
    return np.column_stack([decode(read(material.baseColorTexture)), packed[:, 1:] * factors])


def _min_error(baked: Floats, reference: Floats) -> float:
    """Mean square of the differences of sRGB values (0..1) of two linear channels (n,), at the best gain on the first."""
    target = encode(reference)
    return float(minimize_scalar(lambda gain: ((encode(baked * np.exp(gain)) - target) ** 2).mean(), bounds=LOG_GAIN, method="bounded").fun)
