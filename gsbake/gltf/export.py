"""From textures and mesh to the asset: the GLB in its own frame, cameras, light and previews beside it, and its audit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from blake3 import blake3
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from gsbake import __version__
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Export
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet, Similarity
from gsbake.gltf.audit import as_json, audit, failed
from gsbake.gltf.encode import Sheets, encode_within, quantise
from gsbake.gltf.frame import asset_frame, transforms_json
from gsbake.gltf.write import GltfMesh, build_glb
from gsbake.imaging.exr import read_exr, write_hdr
from gsbake.imaging.png import encode_png
from gsbake.monitor import SILENT, Monitor

#: Height of the exported environment map in pixels.
LIGHT_HEIGHT = 256
#: Longest edge of a preview in pixels.
PREVIEW_SIZE = 1024
#: Deflate level of previews.
PREVIEW_LEVEL = 6


@dataclass(frozen=True)
class ExportOptions:
    """Settings of the export; `materials` and `texture_size` are those of the bake, for the asset's extras."""

    export: Export = Export()
    materials: str = "none"
    texture_size: int = 1024


def export_asset(
    ingest: Path,
    poses: Path,
    surfels: Path,
    baked: Path,
    out: Path,
    options: ExportOptions | None = None,
    *,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Write the asset of the folder `baked` into the folder `out` and return its figures.

    Written: `asset.glb` (glTF's frame), `cameras.json`, `light.hdr` (with materials), `previews/` and `audit.json`. `surfels` is the folder
    with the refined cameras, `ingest` the one that names the user's files. Raises BadInputError when the asset fails its audit.
    """
    options = options or ExportOptions()
    settings = options.export
    cameras = PosedPhotos.open(poses, surfels).cameras
    arrays = _arrays(baked / "mesh.safetensors")
    frame = asset_frame(cameras, arrays["position"])
    mesh = _place(arrays, frame)
    with monitor.part("images"):
        normal, emissive = (read_exr(path) if path.exists() else None for path in (baked / "normal.exr", baked / "emissive.exr"))
        sheets = quantise(read_exr(baked / "base_color.exr"), read_exr(baked / "orm.exr"), normal, emissive)
        geometry = sum(a.nbytes for a in (mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces)) + 4096
        images, saving = encode_within(sheets, int(settings.max_megabytes * 1e6) - geometry)
    monitor.check_stop()
    with monitor.part("write"):
        extras = _extras(options, cameras, mesh, sheets)
        data = build_glb(mesh, images, "asset", f"gsbake {__version__}", settings.copyright, extras, sheets.constants)
        (out / "asset.glb").write_bytes(data)
        (out / "cameras.json").write_text(json.dumps(transforms_json(cameras, frame, _sources(ingest)), indent=1))
        if options.materials != "none":
            _write_light(baked, out, frame)
    with monitor.part("previews"):
        _write_previews(out / "previews", sheets, mesh)
    if saving.text != "full precision":
        monitor.decide("texture precision", saving.text, f"the size asked for is {settings.max_megabytes:g} MB (export.max_megabytes)")
    with monitor.part("audit"):
        passed, rules = _audit(data, out, settings, monitor)
    return {
        "megabytes": len(data) / 1e6,
        "triangles": len(mesh.faces),
        "vertices": len(mesh.position),
        "texture_size": int(sheets.base_color.shape[0]),
        "image_bytes": {name: len(content or b"") for name, content in vars(images).items()},
        "precision": saving.text,
        "scale": extras["scale"],
        "audit_passed": passed,
        "audit_rules": rules,
    }


def _audit(data: bytes, out: Path, settings: Export, monitor: Monitor) -> tuple[int, int]:
    """Check the asset, write `audit.json`; how many rules passed, and how many there are."""
    findings = audit(data, "asset.glb", settings.max_megabytes, settings.max_triangles)
    (out / "audit.json").write_text(json.dumps(as_json(findings), indent=1))
    for finding in findings:
        if not finding.passed and finding.severity == "warning":
            monitor.warn(f"export: {finding.rule}: {finding.detail}.")
    wrong = failed(findings)
    if wrong:
        details = "; ".join(f"{f.rule} ({f.detail})" for f in wrong)
        raise BadInputError(f"export: the asset breaks {len(wrong)} of its rules: {details}; change the mesh or the limits in the profile.")
    return sum(f.passed for f in findings), len(findings)


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of `mesh.safetensors`."""
    try:
        arrays: dict[str, NDArray[Any]] = load_file(path)
    except (OSError, SafetensorError) as error:
        raise BadInputError(f"{path} is not readable ({error}); bake again.") from error
    missing = {"position", "normal", "tangent", "uv", "faces"} - arrays.keys()
    if missing:
        raise BadInputError(f"{path} lacks {', '.join(sorted(missing))}; bake again.")
    return arrays


def _place(arrays: dict[str, NDArray[Any]], frame: Similarity) -> GltfMesh:
    """The mesh in the asset's frame; handedness stays, because the map is a proper similarity."""

    def turned(vectors: NDArray[Any]) -> NDArray[np.float64]:
        out = vectors.astype(np.float64) @ frame.rotation.T
        return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)

    tangent = np.column_stack([turned(arrays["tangent"][:, :3]), arrays["tangent"][:, 3]])
    return GltfMesh(
        frame.apply(arrays["position"].astype(np.float64)).astype(np.float32),
        turned(arrays["normal"]).astype(np.float32),
        tangent.astype(np.float32),
        arrays["uv"].astype(np.float32),
        arrays["faces"].astype(np.int32),
    )


def _extras(options: ExportOptions, cameras: CameraSet, mesh: GltfMesh, sheets: Sheets) -> dict[str, Any]:
    """What the asset says about itself: settings, scale, digests of its content."""
    numbers = None if sheets.constants is None else np.array(sheets.constants, "<f8")

    def digest(*parts: NDArray[Any] | None) -> str:
        hasher = blake3()
        for part in parts:
            if part is not None:
                hasher.update(part.tobytes())
        return hasher.hexdigest(16)

    return {
        "profile": {"materials": options.materials, "texture_size": options.texture_size, "normal_map": sheets.normal is not None},
        "scale": "metres" if cameras.metric else "unknown",
        "poses": cameras.poses,
        "digests": {
            "mesh": digest(mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces),
            "textures": digest(sheets.base_color, sheets.orm, sheets.normal, sheets.emissive, numbers),
        },
    }


def _sources(ingest: Path) -> dict[str, str]:
    """File name of the user's photo by the photo's name inside gsbake."""
    photos = json.loads((ingest / "photos.json").read_text())["photos"]
    return {photo["name"]: PurePath(photo["source"]).name for photo in photos}


def _write_light(baked: Path, out: Path, frame: Similarity) -> None:
    """The learnt environment map, equirectangular, in the asset's frame."""
    from gsbake.shading.environment import EnvironmentLight

    light = EnvironmentLight.load(baked / "light.safetensors")
    write_hdr(out / "light.hdr", light.equirectangular(LIGHT_HEIGHT, frame.rotation, "gltf"))


def _write_previews(folder: Path, sheets: Sheets, mesh: GltfMesh) -> None:
    """PNG images of the maps and of the UV layout."""
    folder.mkdir()
    size = min(PREVIEW_SIZE, sheets.base_color.shape[0])

    def reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), np.uint8)

    named = {"base_color": sheets.base_color, "orm": sheets.orm, "normal": sheets.normal, "emissive": sheets.emissive}
    for name, sheet in named.items():
        if sheet is not None:
            (folder / f"{name}.png").write_bytes(encode_png(reduced(sheet), PREVIEW_LEVEL))
    wires = (reduced(sheets.base_color) // 2 + 64).astype(np.uint8)
    lines = np.rint(mesh.uv[mesh.faces].astype(np.float64) * size * 16 - 8).astype(np.int32)
    cv2.polylines(wires, list(lines), True, (20, 20, 20), 1, cv2.LINE_AA, 4)
    (folder / "uv.png").write_bytes(encode_png(wires, PREVIEW_LEVEL))
