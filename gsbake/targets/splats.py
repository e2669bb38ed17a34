"""Surfels as the PLY of splat viewers: one flat Gaussian a row, in the asset's frame.

Properties and activations of Kerbl et al., *3D Gaussian Splatting for real-time radiance field rendering*, 2023: scales as logarithms,
opacity as logit, rotation (w, x, y, z), colours as spherical harmonics by channel. A surfel has two scales; its thickness is a hundredth of
the smaller one (Huang et al., *2D Gaussian Splatting*, SIGGRAPH 2024). Harmonics turn with the frame: Y(Rᵀd) is linear in Y(d) per degree.

Materials follow as five further properties, which viewers that do not know them skip: `base_color_0` to `_2` (linear), `roughness` and
`metallic`, all 0..1 and of glTF's metallic-roughness model. They are the surfels' own where these carry materials, else the baked ones at
the nearest texel.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.geometry.cameras import Similarity
from gsbake.imaging.srgb import encode
from gsbake.targets.maps import BakedMaps, resized
from gsbake.texturing.texels import rasterise

Doubles = NDArray[np.float64]

#: Thickness of a splat as a share of its smaller scale.
THICKNESS = 0.01
#: Opacity below which a splat is left out: it changes no 8-bit pixel.
MIN_OPACITY = 1 / 255
#: Names of the materials.
MATERIALS = ("base_color_0", "base_color_1", "base_color_2", "roughness", "metallic")
#: Largest edge in texels of the maps that surfels take their materials from: surfels are coarser than texels.
MAP_EDGE = 1024
#: Constant harmonic.
SH0 = 0.28209479177387814
SH1 = 0.4886025119029199
SH2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)


def write_splats(surfels: Path, path: Path, frame: Similarity, maps: BakedMaps | None = None) -> int:
    """Write the surfels of a safetensors file; `frame` maps the unit frame to the asset's. Returns the number of splats.

    `maps` of the asset, in its frame, give the materials of surfels that have none; without them these are left out.
    """
    import torch

    from gsbake.surfels.model import Surfels

    model = Surfels.load(surfels)
    with torch.no_grad():
        opacity = model.opacity().double().numpy()
        keep = opacity >= MIN_OPACITY
        opacity = np.clip(opacity[keep], 1e-6, 1 - 1e-6)
        position = frame.apply(model.position.double().numpy()[keep])
        quaternion = rotated_quaternions(frame.rotation, model.quaternion.double().numpy()[keep])
        scale = model.log_scale.double().numpy()[keep] + np.log(frame.scale)
        normal = model.normal().double().numpy()[keep] @ frame.rotation.T
        materials = np.zeros((len(position), 0))
        if model.pbr:
            own = (model.attributes[name].double().sigmoid().numpy()[keep] for name in ("albedo", "roughness", "metallic"))
            parts = [values.reshape(len(position), -1) for values in own]
            materials = np.concatenate(parts, 1)
            colour = encode(torch.sigmoid(model.attributes["albedo"]).numpy()[keep].astype(np.float32)).astype(np.float64)
            harmonics = ((colour - 0.5) / SH0)[:, None]
        else:
            harmonics = rotated_harmonics(model.attributes["sh"].double().numpy()[keep], frame.rotation)
            materials = materials if maps is None else baked_materials(maps, position)
    thickness = scale.min(1, keepdims=True) + np.log(THICKNESS)
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(len(position), -1)
    columns = [position, normal, harmonics[:, 0], rest, np.log(opacity / (1 - opacity))[:, None], scale, thickness, quaternion, materials]
    names = [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"), *(f"f_rest_{k}" for k in range(rest.shape[1])),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        *MATERIALS[: materials.shape[1]],
    ]  # fmt: skip
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(position)}", *(f"property float {n}" for n in names)]
    rows = np.concatenate(columns, 1).astype("<f4")
    path.write_bytes("\n".join([*header, "end_header", ""]).encode("ascii") + rows.tobytes())
    return len(position)


def baked_materials(maps: BakedMaps, points: Doubles) -> Doubles:
    """Linear base colour, roughness and metallic (n, 5) of the baked surface nearest to `points` (n, 3) in the asset's frame."""
    from scipy.spatial import cKDTree

    edge = min(maps.map_edge, MAP_EDGE)
    texels = rasterise(maps.mesh.uv, maps.mesh.faces, edge)
    nearest = cKDTree(texels.interpolate(maps.mesh.position, maps.mesh.faces)).query(points)[1]
    values = np.concatenate([resized(maps.base_color, edge), resized(maps.orm, edge)[..., 1:]], -1)
    return values.reshape(edge * edge, 5)[texels.index[nearest]].astype(np.float64)


def rotated_quaternions(rotation: NDArray[Any], quaternion: Doubles) -> Doubles:
    """Unit quaternions (n, 4), (w, x, y, z), turned by a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(quaternion[:, [1, 2, 3, 0]])
    return np.asarray(turned.as_quat()[:, [3, 0, 1, 2]])


def rotated_harmonics(harmonics: Doubles, rotation: NDArray[Any]) -> Doubles:
    """Coefficients (n, (degree + 1)², 3) of functions that are turned with the object by a rotation matrix (3, 3)."""
    out = harmonics.copy()
    turn = np.random.default_rng(0).normal(size=(32, 3))
    directions = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    now, before = basis(directions), basis(directions @ rotation)  # rows Rᵀd
    first, width = 1, 3
    while first < harmonics.shape[1]:
        band = slice(first, first + width)
        change = np.linalg.lstsq(now[:, band], before[:, band], rcond=None)[0]
        out[:, band] = np.einsum("ij,njc->nic", change, harmonics[:, band])
        first, width = first + width, width + 2
    return out


def basis(d: Doubles) -> Doubles:
    """Real harmonics (n, 9) of degree 0 to 2 at unit directions (n, 3), in the order and with the signs of the splatting literature."""
    x, y, z = d.T
    return np.stack(
        [
            np.full(len(d), SH0), -SH1 * y, SH1 * z, -SH1 * x, SH2[0] * x * y, -SH2[0] * y * z,
            SH2[1] * (2 * z * z - x * x - y * y), -SH2[0] * x * z, SH2[2] * (x * x - y * y),
        ],
        1,
    )  # fmt: skip
