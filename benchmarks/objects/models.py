"""Procedural test models: shapes made by formula, with textures that are functions of position.

    python -m benchmarks.objects.models OUT

writes one GLB each. Materials cover what the material fit must tell apart: coloured, neutral and dark metals, oxide beside clean metal,
perforated metal, wood with iron bands, coloured glossy plastic, glaze, cloth, print, and an emissive part. Base colours of metals are
measured reflectances (Lagarde & de Rousiers, *Moving Frostbite to PBR*, 2014); noise is a sum of random plane waves, so models do not
depend on library versions.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import xatlas
from PIL import Image
from scipy import ndimage

from benchmarks.objects import hollows
from benchmarks.objects.gauge import gauge, gauge_material
from benchmarks.objects.parts import COPPER, IRON, PATINA, RUST, STEEL, Array, Material, noise, revolved, step
from gsbake.imaging.srgb import encode
from gsbake.texturing.texels import rasterise

#: Edge of the textures in texels, and texels whose material is computed at a time.
TEXTURE_SIZE, CHUNK = 1024, 1 << 19


def figurine(seed: int, amplitude: float = 0.16) -> trimesh.Trimesh:
    """A sphere displaced by smooth noise: convex and concave parts without symmetry."""
    sphere = trimesh.creation.icosphere(5)
    p = np.asarray(sphere.vertices)
    radius = 1 + amplitude * noise(p, 2.2, seed) + 0.25 * amplitude * noise(p, 7.0, seed + 1)
    return trimesh.Trimesh(p * radius[:, None] * [0.85, 0.85, 1.1], sphere.faces, process=False)


def barrel() -> trimesh.Trimesh:
    """A barrel with two proud bands and a rim."""
    return revolved([
        (0, 0), (0.60, 0), (0.64, 0.02), (0.66, 0.2), (0.70, 0.22), (0.72, 0.38), (0.70, 0.4), (0.75, 0.8), (0.75, 1.0), (0.70, 1.4),
        (0.72, 1.42), (0.70, 1.58), (0.66, 1.6), (0.64, 1.78), (0.60, 1.8), (0.56, 1.78), (0.55, 1.7), (0, 1.68),
    ])  # fmt: skip


def bottle() -> trimesh.Trimesh:
    """A slender vessel with a neck and a foot."""
    return revolved([
        (0, 0), (0.42, 0), (0.45, 0.05), (0.30, 0.16), (0.52, 0.5), (0.60, 0.8), (0.48, 1.15), (0.22, 1.4), (0.18, 1.6), (0.30, 1.75),
        (0.27, 1.75), (0.14, 1.6), (0, 1.5),
    ])  # fmt: skip


def helmet() -> trimesh.Trimesh:
    """A dome with a brim and a knob."""
    return revolved([
        (0, 0.05), (0.7, 0.05), (1.0, 0), (1.02, 0.06), (0.8, 0.16), (0.76, 0.4), (0.66, 0.75), (0.42, 1.0), (0.16, 1.1), (0.12, 1.16),
        (0.2, 1.26), (0.14, 1.38), (0, 1.4),
    ])  # fmt: skip


def tea_set() -> trimesh.Trimesh:
    """A pot, two cups and a bowl, close together."""
    pot = revolved([(0, 0), (0.35, 0), (0.55, 0.2), (0.6, 0.45), (0.48, 0.75), (0.2, 0.86), (0.08, 0.9), (0.1, 1.0), (0, 1.03)])
    cup = revolved([(0, 0), (0.2, 0), (0.22, 0.06), (0.34, 0.3), (0.36, 0.5), (0.33, 0.5), (0.3, 0.3), (0.18, 0.1), (0, 0.08)])
    bowl = revolved([(0, 0), (0.24, 0), (0.24, 0.06), (0.46, 0.2), (0.55, 0.36), (0.51, 0.36), (0.42, 0.23), (0.2, 0.12), (0, 0.1)])
    handle = trimesh.creation.torus(0.26, 0.06, major_sections=48, minor_sections=20)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    parts = [pot, handle.apply_translation([0.62, 0, 0.45])]
    for part, x, y in ((cup, -0.75, 0.55), (cup.copy(), -0.78, -0.25), (bowl, 0.1, -1.16)):
        parts.append(part.apply_translation([x, y, 0]))
    return trimesh.util.concatenate(parts)


def lantern() -> trimesh.Trimesh:
    """A cylinder that narrows to a cap, on a wider foot."""
    return revolved([
        (0, 0), (0.62, 0), (0.65, 0.04), (0.64, 0.2), (0.52, 0.24), (0.5, 0.3), (0.5, 0.8), (0.5, 1.24), (0.53, 1.3), (0.52, 1.36),
        (0.34, 1.56), (0.14, 1.64), (0.1, 1.72), (0, 1.75),
    ])  # fmt: skip


def barrel_material(p: Array) -> Material:
    """Oiled wood with dark iron bands."""
    n, angle = len(p), np.arctan2(p[:, 1], p[:, 0])
    stave = np.floor(angle / (2 * np.pi) * 18)
    grain = noise(np.column_stack([6 * np.cos(angle), 6 * np.sin(angle), 0.6 * p[:, 2]]), 4.0, 3)
    tone = 1 + 0.18 * grain + 0.2 * np.sin(stave * 12.9898)
    wood = Material.uniform(n, (0.33, 0.17, 0.075), 0.55).shaded(tone)
    iron = Material.uniform(n, IRON, 0.42, 1.0).shaded(1 + 0.08 * noise(p, 14, 5))
    rim = np.hypot(p[:, 0], p[:, 1]) > 0.66
    band = rim & (((p[:, 2] > 0.21) & (p[:, 2] < 0.39)) | ((p[:, 2] > 1.41) & (p[:, 2] < 1.59)))
    return wood.blend(iron, band.astype(float))


def glaze_material(p: Array) -> Material:
    """White glaze with blue rings and a brown rim."""
    white, blue = Material.uniform(len(p), (0.80, 0.79, 0.75), 0.14), Material.uniform(len(p), (0.04, 0.09, 0.38), 0.14)
    ring = step(np.sin(22 * p[:, 2]), 0.86, 0.06) * (p[:, 2] > 0.15)
    flowers = step(noise(p, 11, 8), 1.25, 0.15)
    return white.blend(blue, np.maximum(ring, flowers))


def iron_material(p: Array) -> Material:
    """Dark iron with rust."""
    iron = Material.uniform(len(p), IRON, 0.38, 1.0).shaded(1 + 0.1 * noise(p, 9, 2))
    rust = Material.uniform(len(p), RUST, 0.85).shaded(1 + 0.25 * noise(p, 16, 4))
    return iron.blend(rust, step(noise(p, 4.5, 6) + 0.25 * noise(p, 18, 7), 0.75, 0.25))


def helmet_material(p: Array) -> Material:
    """Glossy red and cream plastic with polished steel and black rubber."""
    n, height = len(p), p[:, 2]
    red, cream = Material.uniform(n, (0.55, 0.03, 0.025), 0.2), Material.uniform(n, (0.68, 0.60, 0.42), 0.25)
    plastic = red.blend(cream, step(np.cos(4 * np.arctan2(p[:, 1], p[:, 0])), 0.55, 0.05))
    steel, rubber = Material.uniform(n, STEEL, 0.22, 1.0), Material.uniform(n, (0.025, 0.025, 0.027), 0.5)
    metal = (height > 1.12) | ((height > 0.4) & (height < 0.55) & (np.hypot(p[:, 0], p[:, 1]) > 0.6))
    return plastic.blend(steel, metal.astype(float)).blend(rubber, (height < 0.1).astype(float))


def copper_material(p: Array) -> Material:
    """Copper with patina."""
    copper = Material.uniform(len(p), COPPER, 0.3, 1.0).shaded(1 - 0.08 * np.abs(noise(p, 12, 2)))
    patina = Material.uniform(len(p), PATINA, 0.8).shaded(1 + 0.15 * noise(p, 20, 3))
    return copper.blend(patina, step(noise(p, 4.0, 9) - 0.5 * p[:, 2], 0.15, 0.3))


def lantern_material(p: Array) -> Material:
    """Lacquered plastic around perforated steel: round holes of 0.013 in a hexagonal grid, .024 apart, as texture."""
    n, pitch = len(p), 0.024
    lacquer = Material.uniform(n, (0.03, 0.12, 0.20), 0.3).shaded(1 + 0.05 * noise(p, 8, 2))
    steel = Material.uniform(n, STEEL, 0.32, 1.0).shaded(1 + 0.04 * noise(p, 10, 4))
    across = np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) * round(np.pi / pitch)  # in holes, at the radius of .5
    height = pitch * np.sqrt(3) / 2
    row = np.round(p[:, 2] / height)
    beside, above = (across + 0.5 * (row % 2) + 0.5) % 1 - 0.5, p[:, 2] - row * height
    holes = 1 - step(np.hypot(beside * pitch, above), 0.0065, 0.003)
    band = (p[:, 2] > 0.34) & (p[:, 2] < 1.2)
    perforated = steel.blend(Material.uniform(n, (0.01, 0.01, 0.01), 0.8), holes)
    return lacquer.blend(perforated, band.astype(float))


def toy_material(p: Array) -> Material:
    """Woven cloth with plastic eyes and a lamp."""
    n = len(p)
    weave = 1 + 0.2 * np.sin(90 * p[:, 0]) * np.sin(90 * p[:, 2]) + 0.1 * noise(p, 25, 1)
    cloth = Material.uniform(n, (0.30, 0.42, 0.22), 0.9).shaded(weave)
    stripes = Material.uniform(n, (0.62, 0.50, 0.33), 0.9).shaded(weave)
    cloth = cloth.blend(stripes, step(np.sin(9 * p[:, 2]), 0.3, 0.1))
    unit = p / np.linalg.norm(p, axis=1, keepdims=True)
    eye = sum(unit @ (np.array([x, -0.8, 0.5]) / np.linalg.norm([x, -0.8, 0.5])) > 0.985 for x in (-0.35, 0.35)) > 0
    lamp = unit @ np.array([0.8, 0.6, 0.0]) > 0.98
    cloth = cloth.blend(Material.uniform(n, (0.02, 0.02, 0.02), 0.15), eye.astype(float))
    glowing = Material(np.full((n, 3), 0.02), np.full(n, 0.5), np.zeros(n), np.tile([1.0, 0.55, 0.2], (n, 1)))
    return cloth.blend(glowing, lamp.astype(float))


def steel_material(p: Array) -> Material:
    """Brushed steel with engraved dark lines and one green side."""
    n = len(p)
    steel = Material.uniform(n, STEEL, 0.3, 1.0).shaded(1 + 0.05 * noise(p * [1, 1, 8], 10, 4))
    dark = Material.uniform(n, (0.03, 0.03, 0.035), 0.6)
    green = Material.uniform(n, (0.05, 0.22, 0.10), 0.35)
    return steel.blend(green, step(p[:, 0] + 0.3 * noise(p, 2.0, 3), 0.45, 0.04)).blend(dark, step(np.sin(14 * p[:, 2]), 0.93, 0.05))


#: Models by name: shape and material.
MODELS: dict[str, tuple[Callable[[], trimesh.Trimesh], Callable[[Array], Material]]] = {
    "barrel": (barrel, barrel_material),
    "tea_set": (tea_set, glaze_material),
    "rusty_iron": (lambda: figurine(1), iron_material),
    "helmet": (helmet, helmet_material),
    "copper_bottle": (bottle, copper_material),
    "toy": (lambda: figurine(5, 0.2), toy_material),
    "steel": (lambda: figurine(9, 0.12), steel_material),
    "lantern": (lantern, lantern_material),
    "mug": (hollows.mug, hollows.mug_material),
    "bowl": (hollows.bowl, hollows.bowl_material),
    "flower_pot": (hollows.flower_pot, hollows.terracotta_material),
    "box": (hollows.box, hollows.box_material),
    "shoe": (hollows.shoe, hollows.shoe_material),
    "gauge": (gauge, gauge_material),
}


def model_glb(mesh: trimesh.Trimesh, procedure: Callable[[Array], Material], size: int = TEXTURE_SIZE) -> bytes:
    """The GLB (+Y up) of a mesh (Z up) with textures of `size` texels defined by position."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.uint32)
    mapping, faces, uv = xatlas.parametrize(vertices.astype(np.float32), faces)
    vertices, normals = vertices[mapping], np.asarray(mesh.vertex_normals)[mapping]
    top_left = np.column_stack([uv[:, 0], 1 - uv[:, 1]])
    texels = rasterise(top_left, faces.astype(np.int32), size)
    position = texels.interpolate(vertices, faces).astype(np.float64)
    material = Material.joined([procedure(position[start : start + CHUNK]) for start in range(0, len(position), CHUNK)])
    covered = texels.covered()
    nearest = ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True)

    def picture(values: Array) -> Image.Image:
        filled = texels.image(np.clip(values, 0, 1))[tuple(nearest)]
        return Image.fromarray((255 * filled + 0.5).astype(np.uint8))

    orm = np.column_stack([np.ones(len(texels)), material.roughness, material.metallic])
    emission: dict[str, Any] = {}
    if material.emission.any():
        emission = {"emissiveTexture": picture(encode(material.emission)), "emissiveFactor": [1.0, 1.0, 1.0]}
    pbr = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture(encode(material.base)), metallicRoughnessTexture=picture(orm),
        metallicFactor=1.0, roughnessFactor=1.0, **emission,
    )  # fmt: skip
    y_up = np.column_stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]])
    y_up_normals = np.column_stack([normals[:, 0], normals[:, 2], -normals[:, 1]])
    visual = trimesh.visual.TextureVisuals(uv=uv, material=pbr)
    textured = trimesh.Trimesh(y_up, faces, vertex_normals=y_up_normals, visual=visual, process=False)
    buffer = io.BytesIO()
    textured.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def main() -> None:
    """Write the models."""
    parser = argparse.ArgumentParser(description="Write the procedural test models.")
    parser.add_argument("out", type=Path)
    parser.add_argument("names", nargs="*", choices=[[], *MODELS], help="models; all by default")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.names or MODELS:
        shape, procedure = MODELS[name]
        (arguments.out / f"{name}.glb").write_bytes(model_glb(shape(), procedure))
        print(arguments.out / f"{name}.glb")


if __name__ == "__main__":
    main()
