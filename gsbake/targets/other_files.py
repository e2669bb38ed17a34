"""Forms of a target that are no GLB: OBJ with MTL, USDC and USDZ. All of them take their images as PNG or JPEG files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsbake.gltf.write import GltfMesh, GltfTextures
from gsbake.imaging.encoded import decode_image
from gsbake.imaging.png import encode_png
from gsbake.targets.material_images import Images
from gsbake.targets.usd import write_usd


def write_other(
    form: str, out: Path, stem: str, mesh: GltfMesh, textures: GltfTextures, factors: tuple[float, float] | None, extras: dict[str, Any]
) -> list[str]:
    """Write a mesh as "obj", "usdc" or "usdz" into the folder `out`; the names of its files, the main one first."""
    images = Images.of(textures, factors)
    if form == "obj":
        return write_obj(out, stem, mesh, images, metric=extras.get("scale") == "metres")
    return write_usd(out, stem, mesh, images, package=form == "usdz", metric=extras.get("scale") == "metres")


def write_obj(out: Path, stem: str, mesh: GltfMesh, images: Images, metric: bool) -> list[str]:
    """Wavefront OBJ with the MTL keys of physically based materials (map_Pr, map_Pm, norm); roughness and metallic are grey images."""
    files: dict[str, bytes] = {}
    lines = ["# gsbake", "newmtl asset", "Kd 1 1 1", "Ks 0 0 0", "illum 2"]

    def image(key: str, role: str, content: bytes, suffix: str) -> None:
        files[f"{stem}_{role}.{suffix}"] = content
        lines.append(f"{key} {stem}_{role}.{suffix}")

    image("map_Kd", "base_color", *images.files["base_color"])
    if images.roughness is None or images.metallic is None:
        pixels = decode_image(images.files["orm"][0], "the ORM image")
        image("map_Pr", "roughness", encode_png(pixels[..., 1]), "png")
        image("map_Pm", "metallic", encode_png(pixels[..., 2]), "png")
    else:
        lines += [f"Pr {images.roughness:g}", f"Pm {images.metallic:g}"]
    if "normal" in images.files:
        image("norm", "normal", *images.files["normal"])
    if "emissive" in images.files:
        lines.append("Ke 1 1 1")
        image("map_Ke", "emissive", *images.files["emissive"])
    unit = "metres" if metric else "unknown"
    body = [f"# gsbake; +Y up; unit: {unit}", f"mtllib {stem}.mtl", "o asset", "usemtl asset"]
    body += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.position.tolist()]
    body += [f"vt {u:.9g} {1 - v:.9g}" for u, v in mesh.uv.tolist()]
    body += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.normal.tolist()]
    body += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (np.asarray(mesh.faces, np.int64) + 1).tolist()]
    files = {f"{stem}.obj": "\n".join([*body, ""]).encode(), f"{stem}.mtl": "\n".join([*lines, ""]).encode(), **files}
    for name, content in files.items():
        (out / name).write_bytes(content)
    return list(files)
