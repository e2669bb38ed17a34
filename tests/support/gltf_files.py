"""glTF files that gsbake did not write: trimesh's GLB of a ball with textures, and a .gltf with nodes and a file beside it."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image


def write_ball(path: Path, colour: tuple[int, int, int], radius: float = 1.0) -> Path:
    """A textured ball of another program, uniform `colour` (sRGB), roughness .5."""
    ball = trimesh.creation.uv_sphere(radius, count=[24, 24])
    uv = np.column_stack([np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0]) / (2 * np.pi) + 0.5, ball.vertices[:, 2] / radius / 2 + 0.5])
    image = Image.fromarray(np.full((16, 16, 3), colour, np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, roughnessFactor=0.5, metallicFactor=0.0)
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    path.write_bytes(ball.export(file_type="glb"))
    return path


def two_triangles(**changes: Any) -> dict[str, Any]:
    """A .gltf document: one red triangle in the plane z = 0, placed twice by nodes, once moved by (3, 0, 0) and scaled by 2."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(positions).decode()
    return {
        "asset": {"version": "2.0", "generator": "hand"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0], "scale": [2, 2, 2]}],
        "meshes": [{"name": "triangle", "primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"name": "red", "doubleSided": True, "pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1], "metallicFactor": 0}}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(positions)}],
        "buffers": [{"byteLength": len(positions), "uri": uri}],
    } | changes
