"""GLB reader for rendering: linear base colour, unpacked channels, decoded normals, factors applied."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsbake.errors import BadInputError
from gsbake.gltf.read import GltfAsset, read_glb
from gsbake.imaging.srgb import decode
from gsbake.report.render import Asset, Floats

#: Sampler wrap mode CLAMP_TO_EDGE of glTF (an OpenGL constant).
CLAMP_TO_EDGE = 33071


def open_asset(path: Path, unlit: bool = False) -> Asset:
    """Read the GLB at `path`. `unlit`: its base colour contains the shading of the photos. Raises BadInputError for an invalid GLB."""
    return from_gltf(read_glb(path), unlit, str(path))


def from_gltf(file: GltfAsset, unlit: bool, name: str) -> Asset:
    """Asset of a parsed GLB; ambient occlusion is 1 without an occlusion texture, a missing texture is replaced by its factor.

    Raises BadInputError for a mesh or material that cannot be rendered: the renderer is compiled code that checks no bounds.
    """
    missing = [k for k in ("POSITION", "NORMAL", "TEXCOORD_0") if k not in file.attributes]
    if missing:
        raise BadInputError(f"{name} lacks the vertex attributes {', '.join(missing)}; export it again.")
    count = len(file.attributes["POSITION"])
    if not len(file.faces) or file.faces.min() < 0 or file.faces.max() >= count:
        raise BadInputError(f"{name} has no triangles, or corners that are no vertices; export it again.")
    if not all(np.isfinite(values).all() for values in file.attributes.values()):
        raise BadInputError(f"{name} has vertices that are not finite; export it again.")
    try:
        return _rendered(file, unlit)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError, OverflowError) as error:
        reason = " ".join(repr(error).split())[:200]
        raise BadInputError(f"{name} has a material that cannot be read ({reason}); export it again.") from error


def _rendered(file: GltfAsset, unlit: bool) -> Asset:
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
    normal, emissive = file.image("normal"), file.image("emissive")
    emissive_factor = np.array(material.get("emissiveFactor", (0, 0, 0)), np.float32)
    samplers = file.document.get("samplers") or [{}]
    return Asset(
        position=file.attributes["POSITION"].astype(np.float64),
        normal=file.attributes["NORMAL"].astype(np.float32),
        tangent=file.attributes["TANGENT"].astype(np.float32) if "TANGENT" in file.attributes else None,
        uv=file.attributes["TEXCOORD_0"].astype(np.float32),
        faces=file.faces.astype(np.int32),
        base_color=base,
        orm=orm,
        normal_map=None if normal is None else normal.astype(np.float32) / np.float32(127.5) - 1,
        emissive=None if emissive is None else decode(emissive.astype(np.float32) / 255) * emissive_factor,
        unlit=unlit,
        wrap=samplers[0].get("wrapS") != CLAMP_TO_EDGE,
    )
