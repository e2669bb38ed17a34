"""What is in a glTF file: meshes, materials, textures, sizes, extensions, and the audit of gsbake's own rules."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.config.schema import Export
from gsbake.gltf.audit import as_json, audit
from gsbake.gltf.encode import size_limit
from gsbake.gltf.scene import Scene, open_scene
from gsbake.imaging.encoded import image_format
from gsbake.imaging.image_process import read_image


def inspect_file(path: Path) -> dict[str, Any]:
    """Figures of the file at `path` as a JSON-serialisable document. Raises BadInputError where it is no readable glTF file.

    `audit` holds the findings of the rules for gsbake's own assets under the default limits, for a GLB; other files have none.
    """
    scene = open_scene(path)
    document = scene.document
    low, high = scene.vertices.min(0), scene.vertices.max(0)
    textures = _textures(scene)
    data, limits = path.read_bytes(), Export()
    edges = [t["width"] for t in textures]
    megabytes = size_limit(limits.max_megabytes, max(edges, default=0), min(edges, default=0))
    return {
        "file": str(path),
        "bytes": document.size,
        "container": "GLB" if data[:4] == b"glTF" else "glTF",
        "generator": document.json["asset"].get("generator"),
        "copyright": document.json["asset"].get("copyright"),
        "extras": document.json["asset"].get("extras"),
        "extensions": [str(e) for e in document.json.get("extensionsUsed", [])],
        "extensions_required": [str(e) for e in document.json.get("extensionsRequired", [])],
        "nodes": len(document.json.get("nodes", [])),
        "animations": len(document.json.get("animations", [])),
        "triangles": sum(len(p.faces) for p in scene.parts),
        "vertices": sum(len(p.position) for p in scene.parts),
        "bounds": {"min": low.tolist(), "max": high.tolist(), "size": (high - low).tolist()},
        "meshes": [
            {
                "name": part.name,
                "triangles": len(part.faces),
                "vertices": len(part.position),
                "uv_sets": sorted(part.uv),
                "colours": part.colour is not None,
                "material": scene.materials[part.material].name or part.material,
            }
            for part in scene.parts
        ],
        "materials": _materials(scene),
        "textures": textures,
        "texture_bytes": sum(t["bytes"] for t in textures),
        "gpu_megabytes": sum(t["width"] * t["height"] * 4 * 4 / 3 for t in textures) / 1e6,
        "notes": list(scene.notes),
        "audit": as_json(audit(data, path.name, megabytes, limits.max_triangles, foreign=True)) if data[:4] == b"glTF" else [],
    }


def _materials(scene: Scene) -> list[dict[str, Any]]:
    """Records of the materials that a part uses."""
    used = Counter(p.material for p in scene.parts)
    return [
        {
            "name": scene.materials[k].name,
            "textures": sorted(scene.materials[k].textures),
            "base_color": list(scene.materials[k].base_color),
            "roughness": scene.materials[k].roughness,
            "metallic": scene.materials[k].metallic,
            "alpha_mode": scene.materials[k].alpha_mode,
            "double_sided": scene.materials[k].double_sided,
            "unlit": scene.materials[k].unlit,
        }
        for k in used
    ]


def _textures(scene: Scene) -> list[dict[str, Any]]:
    """Records of the images that a material uses, with their roles."""
    roles: dict[int, set[str]] = {}
    for part in scene.parts:
        for role, use in scene.materials[part.material].textures.items():
            roles.setdefault(use.image, set()).add(role)
    out = []
    for index, names in sorted(roles.items()):
        with scene.document.readable():
            content = scene.document.image(index)
        pixels = read_image(content, f"image {index} of '{scene.document.name}'")
        out.append(
            {
                "image": index,
                "roles": sorted(names),
                "format": image_format(content),
                "width": int(pixels.shape[1]),
                "height": int(pixels.shape[0]),
                "alpha": bool(np.any(pixels[..., 3] < 255)),
                "bytes": len(content),
            }
        )
    return out
