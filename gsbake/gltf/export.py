"""Export of the asset: GLB in the asset frame, cameras, environment map, previews and audit."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import cv2
import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from gsbake import __version__
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Export, Scale
from gsbake.errors import BadInputError
from gsbake.geometry.cameras import CameraSet, Similarity
from gsbake.geometry.raycast import RayCaster
from gsbake.gltf.audit import as_json, audit, failed
from gsbake.gltf.baked import load_mesh_arrays, mesh_in_frame, read_texture
from gsbake.gltf.encode import TextureMaps, encode_within_budget, halved_to_fit, quantise, size_limit
from gsbake.gltf.frame import asset_frame, transforms_json
from gsbake.gltf.write import GltfMesh, build_glb
from gsbake.imaging.exr import write_hdr
from gsbake.imaging.png import encode_png
from gsbake.monitor import SILENT, Monitor
from gsbake.scale.measure import MetricScale, measure_scale
from gsbake.scale.triangulation import find_entry
from gsbake.scale.upright import front_rotation, measure_rotation

#: Height of the exported environment map in pixels.
LIGHT_HEIGHT = 256
#: Longest edge of a preview in pixels.
PREVIEW_SIZE = 1024
#: Deflate level of previews.
PREVIEW_LEVEL = 6


@dataclass(frozen=True)
class ExportOptions:
    """Settings of the export; `materials` is a setting of the bake that the asset's extras record."""

    export: Export = Export()
    materials: str = "none"
    scale: Scale = Scale()


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
    """Write the asset of the artifact folder `baked` into the folder `out` and return its figures.

    Written: `asset.glb` (asset frame, +Y up), `cameras.json`, `light.hdr` (with materials), `previews/` and `audit.json`. The artifact
    folder `surfels` holds refined cameras, `ingest` the names of the user's files. Raises BadInputError when the asset fails its audit.
    """
    options = options or ExportOptions()
    settings = options.export
    posed = PosedPhotos.open(poses, surfels)
    cameras = posed.cameras
    arrays = load_mesh_arrays(baked / "mesh.safetensors")
    with monitor.part("scale"):
        surface = RayCaster(arrays["position"], arrays["faces"])
        scale = measure_scale(ingest, poses, options.scale, surface, cameras.to_world, monitor=monitor)
    if scale is not None:
        to_world = cameras.to_world.then(Similarity(scale.metres))
        cameras = replace(cameras, to_world=to_world, metric=True)
    with monitor.part("up axis"):
        rotation = measure_rotation(ingest, posed, surfels, settings, options.scale, monitor=monitor)
    cameras = replace(cameras, to_world=cameras.to_world.then(Similarity(1.0, rotation)))
    if settings.front:
        turn = _front(ingest, cameras, settings.front, arrays["position"])
        cameras = replace(cameras, to_world=cameras.to_world.then(Similarity(1.0, turn)))
    frame = asset_frame(cameras, arrays["position"], settings.origin)
    mesh = mesh_in_frame(arrays, frame)
    if not np.isfinite(mesh.position).all():
        raise BadInputError("export: the object is too large for the asset's single precision; check the scale of the poses.")
    with monitor.part("images"):
        normal, emissive = (read_texture(path) if path.exists() else None for path in (baked / "normal.exr", baked / "emissive.exr"))
        maps = quantise(read_texture(baked / "base_color.exr"), read_texture(baked / "orm.exr"), normal, emissive)
        geometry = sum(a.nbytes for a in (mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces)) + 4096
        limit = size_limit(settings.max_megabytes, len(maps.base_color), len(maps.orm))
        maps = halved_to_fit(maps, budget := int(limit * 1e6) - geometry)
        images, level = encode_within_budget(maps, budget)
    monitor.check_stop()
    with monitor.part("write"):
        extras = _extras(options, cameras, mesh, maps, scale)
        data = build_glb(mesh, images, "asset", f"gsbake {__version__}", settings.copyright, extras, maps.factors)
        (out / "asset.glb").write_bytes(data)
        (out / "cameras.json").write_bytes(json.dumps(transforms_json(cameras, frame, _source_file_names(ingest)), indent=1).encode())
        if options.materials != "none":
            _write_light(baked, out, frame)
    with monitor.part("previews"):
        _write_previews(out / "previews", maps, mesh)
    if level.text != "full precision":
        monitor.decide("texture precision", level.text, f"the size limit is {limit:g} MB (export.max_megabytes)")
    with monitor.part("audit"):
        passed, rules = _audit(data, out, limit, settings.max_triangles, monitor)
    return {
        "megabytes": len(data) / 1e6,
        "triangles": len(mesh.faces),
        "vertices": len(mesh.position),
        "texture_size": int(maps.base_color.shape[0]),
        "image_bytes": {name: len(content or b"") for name, content in vars(images).items()},
        "precision": level.text,
        "scale": extras["scale"],
        **({} if scale is None else _size(mesh, scale)),
        "audit_passed": passed,
        "audit_rules": rules,
    }


def _front(ingest: Path, cameras: CameraSet, photo: str, position: NDArray[Any]) -> NDArray[np.float64]:
    """The rotation (3, 3) of the world that makes the mesh with vertices (v, 3) face the camera of a photo.

    Raises BadInputError for a photo that is none, or has no camera.
    """
    entries = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
    name = find_entry(entries, photo, "export.front")["name"]
    camera = next((camera for camera in cameras.cameras if camera.name == name), None)
    if camera is None:
        raise BadInputError(f"The photo {photo} of export.front was not registered and has no camera; use another photo.")
    placed = cameras.to_world.apply(np.asarray(position, np.float64))
    return front_rotation(camera.moved(cameras.to_world), (placed.min(0) + placed.max(0)) / 2)


def _size(mesh: GltfMesh, scale: MetricScale) -> dict[str, Any]:
    """Figures of an asset in metres."""
    extent = mesh.position.max(0) - mesh.position.min(0)
    return {"size_metres": [round(float(edge), 6) for edge in extent], "scale_relative_error": scale.relative_error}


def _audit(data: bytes, out: Path, megabytes: float, triangles: int, monitor: Monitor) -> tuple[int, int]:
    """Audit the asset and write `audit.json`; returns the number of passed rules and of all rules."""
    findings = audit(data, "asset.glb", megabytes, triangles)
    (out / "audit.json").write_bytes(json.dumps(as_json(findings), indent=1).encode())
    for finding in findings:
        if not finding.passed and finding.severity == "warning":
            monitor.warn(f"export: {finding.rule}: {finding.detail}.")
    errors = failed(findings)
    if errors:
        details = "; ".join(f"{f.rule} ({f.detail})" for f in errors)
        raise BadInputError(f"export: the asset fails {len(errors)} audit rules: {details}; change the mesh or the limits in the profile.")
    return sum(f.passed for f in findings), len(findings)


def _extras(options: ExportOptions, cameras: CameraSet, mesh: GltfMesh, maps: TextureMaps, scale: MetricScale | None) -> dict[str, Any]:
    """The asset's extras: settings, scale, digests of its content."""
    factors = None if maps.factors is None else np.array(maps.factors, "<f8")

    def digest(*parts: NDArray[Any] | None) -> str:
        hasher = blake3()
        for part in parts:
            if part is not None:
                hasher.update(part.tobytes())
        return hasher.hexdigest(16)

    return {
        "profile": {"materials": options.materials, "texture_size": len(maps.base_color), "normal_map": maps.normal is not None},
        "scale": "metres" if cameras.metric else "unknown",
        **({} if scale is None else {"scale_relative_error": scale.relative_error}),
        "poses": cameras.poses,
        "digests": {
            "mesh": digest(mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces),
            "textures": digest(maps.base_color, maps.orm, maps.normal, maps.emissive, factors),
        },
    }


def _source_file_names(ingest: Path) -> dict[str, str]:
    """File name of the user's photo by the photo's name in gsbake."""
    photos = json.loads((ingest / "photos.json").read_text(encoding="utf-8"))["photos"]
    return {photo["name"]: PurePath(photo["source"]).name for photo in photos}


def _write_light(baked: Path, out: Path, frame: Similarity) -> None:
    """Write the estimated environment map, equirectangular, in the asset frame."""
    from gsbake.shading.environment import EnvironmentLight

    light = EnvironmentLight.load(baked / "light.safetensors")
    write_hdr(out / "light.hdr", light.equirectangular(LIGHT_HEIGHT, frame.rotation, "gltf"))


def _write_previews(folder: Path, maps: TextureMaps, mesh: GltfMesh) -> None:
    """Write PNG previews of the maps and of the UV layout."""
    folder.mkdir(exist_ok=True)  # as the other files, those of an earlier export are overwritten
    size = min(PREVIEW_SIZE, maps.base_color.shape[0])

    def reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), np.uint8)

    images = {"base_color": maps.base_color, "orm": maps.orm, "normal": maps.normal, "emissive": maps.emissive}
    for name, image in images.items():
        if image is not None:
            (folder / f"{name}.png").write_bytes(encode_png(reduced(image), PREVIEW_LEVEL))
    wireframe = (reduced(maps.base_color) // 2 + 64).astype(np.uint8)
    lines = np.rint(mesh.uv[mesh.faces].astype(np.float64) * size * 16 - 8).astype(np.int32)
    cv2.polylines(wireframe, list(lines), True, (20, 20, 20), 1, cv2.LINE_AA, 4)
    (folder / "uv.png").write_bytes(encode_png(wireframe, PREVIEW_LEVEL))
