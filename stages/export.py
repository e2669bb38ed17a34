"""Textures and mesh to the asset: the GLB in its own frame, cameras, light and previews beside it, and the audit of it all."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from gsbake.pipeline.errors import BadInputError
from gsbake.pipeline.stage import Context, Stage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gsbake.geometry.cameras import CameraSet, Similarity
    from gsbake.gltf.encode import Sheets
    from gsbake.gltf.write import GltfMesh

#: Height of the exported environment light in pixels.
LIGHT_HEIGHT = 256
#: Longest edge of a preview in pixels.
PREVIEW_SIZE = 1024
#: Deflate level of previews: quick, for nobody ships them.
PREVIEW_LEVEL = 6


def run(ctx: Context) -> dict[str, Any]:
    """Write `asset.glb`, `cameras.json`, `light.hdr` (with materials), `previews/` and `audit.json`; return the asset's figures."""
    import gsbake
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.gltf.audit import as_json, audit, failed
    from gsbake.gltf.encode import encode_within, quantise
    from gsbake.gltf.frame import asset_frame, transforms_json
    from gsbake.gltf.write import build_glb
    from gsbake.imaging.exr import read_exr

    settings = ctx.settings.export
    baked = ctx.inputs["bake"]
    cameras = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["refine"]).cameras
    arrays = _arrays(ctx)
    frame = asset_frame(cameras, arrays["position"])
    mesh = _place(arrays, frame)
    with ctx.part("images"):
        normal, emissive = (read_exr(path) if path.exists() else None for path in (baked / "normal.exr", baked / "emissive.exr"))
        sheets = quantise(read_exr(baked / "base_color.exr"), read_exr(baked / "orm.exr"), normal, emissive)
        geometry = sum(a.nbytes for a in (mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces)) + 4096
        images, saving = encode_within(sheets, int(settings.max_megabytes * 1e6) - geometry)
    ctx.check_stop()
    with ctx.part("write"):
        extras = _extras(ctx, cameras, mesh, sheets)
        data = build_glb(mesh, images, "asset", f"gsbake {gsbake.__version__}", settings.copyright, extras, sheets.constants)
        (ctx.out / "asset.glb").write_bytes(data)
        (ctx.out / "cameras.json").write_text(json.dumps(transforms_json(cameras, frame, _sources(ctx)), indent=1))
        if ctx.settings.bake.materials != "none":
            _write_light(ctx, frame)
    with ctx.part("previews"):
        _write_previews(ctx, sheets, mesh)
    if saving.text != "full precision":
        ctx.decide("texture precision", saving.text, f"{settings.max_megabytes:g} MB is the size asked for (export.max_megabytes)")
    with ctx.part("audit"):
        findings = audit(data, "asset.glb", settings.max_megabytes, settings.max_triangles)
        (ctx.out / "audit.json").write_text(json.dumps(as_json(findings), indent=1))
    for finding in findings:
        if not finding.passed and finding.severity == "warning":
            ctx.warn(f"export: {finding.rule}: {finding.detail}.")
    wrong = failed(findings)
    if wrong:
        told = "; ".join(f"{f.rule} ({f.detail})" for f in wrong)
        raise BadInputError(f"export: the asset breaks {len(wrong)} of its rules: {told}; change the mesh or the limits in the profile.")
    return {
        "megabytes": len(data) / 1e6,
        "triangles": len(mesh.faces),
        "vertices": len(mesh.position),
        "texture_size": int(sheets.base_color.shape[0]),
        "image_bytes": {name: len(content or b"") for name, content in vars(images).items()},
        "precision": saving.text,
        "scale": extras["scale"],
        "audit_passed": sum(f.passed for f in findings),
        "audit_rules": len(findings),
    }


def _arrays(ctx: Context) -> dict[str, NDArray[Any]]:
    """The arrays of `mesh.safetensors`."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = ctx.inputs["bake"] / "mesh.safetensors"
    try:
        arrays: dict[str, NDArray[Any]] = load_file(path)
    except (OSError, SafetensorError) as error:
        raise BadInputError(f"{path} is not readable ({error}); bake again.") from error
    missing = {"position", "normal", "tangent", "uv", "faces"} - arrays.keys()
    if missing:
        raise BadInputError(f"{path} lacks {', '.join(sorted(missing))}; bake again.")
    return arrays


def _place(arrays: dict[str, NDArray[Any]], frame: Similarity) -> GltfMesh:
    """The mesh in the asset's frame; handedness stays, for the map is a proper similarity."""
    import numpy as np

    from gsbake.gltf.write import GltfMesh

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


def _extras(ctx: Context, cameras: CameraSet, mesh: GltfMesh, sheets: Sheets) -> dict[str, Any]:
    """What the asset says about itself: settings, scale, digests of what it holds."""
    import numpy as np
    from blake3 import blake3

    numbers = None if sheets.constants is None else np.array(sheets.constants, "<f8")

    def digest(*parts: NDArray[Any] | None) -> str:
        hasher = blake3()
        for part in parts:
            if part is not None:
                hasher.update(part.tobytes())
        return hasher.hexdigest(16)

    chosen = ctx.settings.bake
    return {
        "profile": {"materials": chosen.materials, "texture_size": chosen.size, "normal_map": sheets.normal is not None},
        "scale": "metres" if cameras.metric else "unknown",
        "poses": cameras.poses,
        "digests": {
            "mesh": digest(mesh.position, mesh.normal, mesh.tangent, mesh.uv, mesh.faces),
            "textures": digest(sheets.base_color, sheets.orm, sheets.normal, sheets.emissive, numbers),
        },
    }


def _sources(ctx: Context) -> dict[str, str]:
    """File name of the person's photo by the photo's name inside gsbake."""
    from pathlib import PurePath

    photos = json.loads((ctx.inputs["ingest"] / "photos.json").read_text())["photos"]
    return {photo["name"]: PurePath(photo["source"]).name for photo in photos}


def _write_light(ctx: Context, frame: Similarity) -> None:
    """The learnt environment light, equirectangular, in the asset's frame."""
    from gsbake.imaging.exr import write_hdr
    from gsbake.shading.environment import EnvironmentLight

    light = EnvironmentLight.load(ctx.inputs["bake"] / "light.safetensors")
    write_hdr(ctx.out / "light.hdr", light.equirectangular(LIGHT_HEIGHT, frame.rotation, "gltf"))


def _write_previews(ctx: Context, sheets: Sheets, mesh: GltfMesh) -> None:
    """PNG sheets of the maps and of the UV layout."""
    import cv2
    import numpy as np

    from gsbake.imaging.png import encode_png

    folder = ctx.out / "previews"
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


STAGE = Stage(
    name="export",
    version=2,
    title="Asset",
    run=run,
    needs=("ingest", "poses", "refine", "bake"),
    settings=("export.*", "bake.materials", "bake.size"),
)
