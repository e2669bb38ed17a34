"""The exported GLB, opened for drawing: glTF's conventions undone (sRGB base colour, packed channels, coded normals, factors)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsbake.errors import BadInputError
from gsbake.gltf.read import GltfAsset, read_glb
from gsbake.imaging.srgb import decode
from gsbake.report.render import Asset, Floats

#: glTF's sampler value for clamping to the edge.
CLAMP = 33071


def open_asset(path: Path, unlit: bool = False) -> Asset:
    """Read the GLB at `path`; `unlit` when its base colour holds the photographed light. Raises BadInputError when it cannot be drawn."""
    return from_gltf(read_glb(path), unlit, str(path))


def from_gltf(file: GltfAsset, unlit: bool, name: str) -> Asset:
    """The drawable asset of a GLB; occlusion is 1 where the material names no occlusion texture, a missing image is its factor alone."""
    missing = [k for k in ("POSITION", "NORMAL", "TEXCOORD_0") if k not in file.attributes]
    if missing:
        raise BadInputError(f"{name} lacks the vertex attributes {', '.join(missing)}; export it again.")
    material = (file.document.get("materials") or [{}])[0]
    surface = material.get("pbrMetallicRoughness", {})
    colour = file.image("base_color")
    base: Floats = np.ones((1, 1, 3), np.float32) if colour is None else decode(colour.astype(np.float32) / 255)
    base = base * np.array(surface.get("baseColorFactor", (1, 1, 1, 1))[:3], np.float32)
    packed = file.image("orm")
    orm: Floats = np.ones((1, 1, 3), np.float32) if packed is None else packed.astype(np.float32) / np.float32(255)
    orm = orm * np.array([1, surface.get("roughnessFactor", 1.0), surface.get("metallicFactor", 1.0)], np.float32)
    occlusion = file.image("occlusion")
    if packed is None and occlusion is not None:
        orm = np.broadcast_to(orm, occlusion.shape).copy()
    if occlusion is None:
        orm[..., 0] = 1
    elif occlusion.shape == orm.shape:
        orm[..., 0] = occlusion[..., 0].astype(np.float32) / 255
    coded, glow = file.image("normal"), file.image("emissive")
    strength = np.array(material.get("emissiveFactor", (0, 0, 0)), np.float32)
    samplers = file.document.get("samplers") or [{}]
    return Asset(
        position=file.attributes["POSITION"].astype(np.float64),
        normal=file.attributes["NORMAL"].astype(np.float32),
        tangent=file.attributes["TANGENT"].astype(np.float32) if "TANGENT" in file.attributes else None,
        uv=file.attributes["TEXCOORD_0"].astype(np.float32),
        faces=file.faces.astype(np.int32),
        base_color=base,
        orm=orm,
        normal_map=None if coded is None else coded.astype(np.float32) / np.float32(127.5) - 1,
        emissive=None if glow is None else decode(glow.astype(np.float32) / 255) * strength,
        unlit=unlit,
        wrap=samplers[0].get("wrapS") != CLAMP,
    )
