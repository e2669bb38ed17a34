"""Audit of the asset against rules for gsbake's output.

A failed rule of severity "error" fails the export; "warning" is reported to the user; "info" is only recorded. The rules follow the
glTF 2.0 specification, the Khronos *3D Commerce Asset Creation Guidelines 1.0* and the Khronos validator. They are checked on the bytes of
the finished file, independently of the writer.
"""

from __future__ import annotations

import struct
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.gltf.document import FAULTS
from gsbake.gltf.read import GltfAsset, parse_glb
from gsbake.imaging.encoded import image_format, image_size
from gsbake.texturing.given_uvs import MAX_OVERLAP
from gsbake.texturing.texels import overlapping

Severity = Literal["error", "warning", "info"]

#: Range of common texture sizes, in texels.
USUAL_SIZES = (512, 2048)
#: Range of sRGB codes of base colours of real surfaces.
PLAUSIBLE_COLOUR = (30, 243)
#: Resolution at which overlaps of the UV layout are detected, in texels.
OVERLAP_SIZE = 2048
#: Largest share of overlapping texels, for rounding at shared edges.
MAX_OVERLAP_SHARE = 1e-5
#: Area of the triangles, in unit squares, above which they overlap without a look at the texels.
MAX_COVERED = 10.0
#: Area of the triangles' boxes, in unit squares, up to which the texels are looked at: seconds.
MAX_BOXES = 200.0
#: Share of texels of a normal map whose vectors may be off unit length.
MAX_NON_UNIT = 0.02
#: PNG chunks that viewers interpret differently.
COLOUR_CHUNKS = ("gAMA", "iCCP", "cHRM", "sRGB")


@dataclass(frozen=True)
class Finding:
    """Result of one rule."""

    rule: str
    passed: bool
    detail: str
    severity: Severity


def audit(
    data: bytes,
    name: str,
    max_megabytes: float,
    max_triangles: int,
    extensions: frozenset[str] = frozenset(),
    budget: Severity = "warning",
    foreign: bool = False,
) -> list[Finding]:
    """Audit the bytes of a GLB; `name` identifies it in errors. An unreadable file gives one failed finding.

    `extensions` may be required by the file; `budget` is the severity of a file that is too large; `foreign` as for `parse_glb`.
    """
    try:
        asset = parse_glb(data, name, foreign)
    except BadInputError as error:
        return [Finding("readable GLB", False, str(error), "error")]
    found: list[Finding] = []

    def check(rule: str, passed: bool, detail: str, severity: Severity = "error") -> None:
        found.append(Finding(rule, bool(passed), detail, severity))

    check("readable GLB", True, f"{len(data)} bytes")
    try:
        with np.errstate(all="ignore"):  # a value that overflows fails the rule that it is for
            _structure(asset, check, extensions)
            _geometry(asset, check, max_triangles)
            _uv_layout(asset, check)
            _images(asset, check)
    except BadInputError as error:
        check("readable images", False, str(error))
    except (*FAULTS, struct.error) as error:
        check("well-formed document", False, " ".join(repr(error).split())[:200])
    megabytes = len(data) / 1e6
    check("file size", megabytes <= max_megabytes, f"{megabytes:.2f} MB of {max_megabytes:g} MB", budget)
    return found


def failed(findings: list[Finding]) -> list[Finding]:
    """Failed findings of severity "error"."""
    return [f for f in findings if not f.passed and f.severity == "error"]


def as_json(findings: list[Finding]) -> list[dict[str, Any]]:
    """Findings as JSON-serialisable records."""
    return [asdict(f) for f in findings]


def _structure(asset: GltfAsset, check: Any, allowed: frozenset[str]) -> None:
    """Rules of the document: version, one mesh and material, self-contained, buffer views in order."""
    document = asset.document
    header = document["asset"]
    check("glTF version", header.get("version") == "2.0", f"version {header.get('version')}")
    check("generator", bool(header.get("generator")), str(header.get("generator", "none")), "warning")
    scale = header.get("extras", {}).get("scale")
    check("scale is stated", scale in ("metres", "unknown"), f"asset.extras.scale = {scale}", "warning")
    counts = {key: len(document.get(key, [])) for key in ("meshes", "materials", "scenes", "buffers")}
    primitives = sum(len(m["primitives"]) for m in document["meshes"])
    levels = 1 + len(document["nodes"][0].get("extensions", {}).get("MSFT_lod", {}).get("ids", [])) if document.get("nodes") else 1
    single = counts["meshes"] == primitives == levels and 1 <= counts["materials"] <= levels
    check("one mesh, one material", single, f"{counts}, {primitives} primitives, {levels} levels of detail")
    external = [x for key in ("buffers", "images") for x in document.get(key, []) if "uri" in x]
    check("self-contained", not external, f"{len(external)} external references")
    extensions = document.get("extensionsRequired", [])
    unasked = [name for name in extensions if name not in allowed]
    check("no required extensions", not unasked, ", ".join(extensions) or "none")
    material = document["materials"][0] if document.get("materials") else {}
    check("opaque", material.get("alphaMode", "OPAQUE") == "OPAQUE", f"alphaMode {material.get('alphaMode', 'OPAQUE')}")
    end, aligned, total = 0, True, document["buffers"][0]["byteLength"]
    for entry in document["bufferViews"]:
        view = entry.get("extensions", {}).get("EXT_meshopt_compression", entry)
        start = view.get("byteOffset", 0)
        aligned = aligned and start % 4 == 0 and start >= end
        end = start + view["byteLength"]
    check("buffer views aligned", aligned and end <= total, f"{len(document['bufferViews'])} views, {end} of {total} bytes")


def _geometry(asset: GltfAsset, check: Any, max_triangles: int) -> None:
    """Rules of the attributes: finite, unit length, in range, bounds as stated."""
    attributes, faces = asset.attributes, asset.faces
    missing = [k for k in ("POSITION", "NORMAL", "TEXCOORD_0") if k not in attributes]
    if "normal" in asset.roles and "TANGENT" not in attributes:
        missing.append("TANGENT")
    check("attributes present", not missing, "missing: " + ", ".join(missing) if missing else ", ".join(attributes))
    check("triangle count", 0 < len(faces) <= max_triangles, f"{len(faces)} of at most {max_triangles}")
    position = attributes["POSITION"]
    check("finite values", all(np.isfinite(a).all() for a in attributes.values()), f"{len(position)} vertices")
    in_range = len(faces) > 0 and faces.min() >= 0 and faces.max() < len(position)
    check("indices in range", in_range, f"{len(faces)} triangles, {len(position)} vertices")
    accessor = asset.document["accessors"][asset.document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    bounds = np.array([accessor.get("min", [np.nan] * 3), accessor.get("max", [np.nan] * 3)], np.float32)
    if accessor.get("normalized"):
        bounds = bounds / np.float32(65535 if accessor["componentType"] == 5123 else 255)
    check("POSITION bounds", np.array_equal(bounds, np.stack([position.min(0), position.max(0)])), f"{bounds.tolist()}")
    if in_range:
        corner = position[faces].astype(np.float64)
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        check("no degenerate triangles", (area > 0).all(), f"{int((area <= 0).sum())} without area", "warning")
    if "NORMAL" in attributes:
        error = float(np.abs(np.linalg.norm(attributes["NORMAL"], axis=1) - 1).max())
        check("unit normals", error < 5e-4, f"length error at most {error:.1e}")
    if "TANGENT" in attributes and "NORMAL" in attributes:
        tangent = attributes["TANGENT"].astype(np.float64)
        error = float(np.abs(np.linalg.norm(tangent[:, :3], axis=1) - 1).max())
        check("unit tangents", error < 5e-4 and bool((np.abs(tangent[:, 3]) == 1).all()), f"length error at most {error:.1e}; w is ±1")
        cosine = float(np.abs(np.einsum("nd,nd->n", tangent[:, :3], attributes["NORMAL"].astype(np.float64))).max())
        check("tangents in the surface", cosine < 1e-2, f"cosine to the normal at most {cosine:.1e}")


def _uv_layout(asset: GltfAsset, check: Any) -> None:
    """Rules of the UVs: in the unit square, no overlapping triangles, mirrored ones as the tangents say.

    gsbake's own atlas has neither mirrored nor overlapping triangles; UVs that were given may have.
    """
    uv, faces = asset.attributes.get("TEXCOORD_0", np.zeros((0, 2))).astype(np.float64), asset.faces
    if not len(uv) or faces.min(initial=0) < 0 or faces.max(initial=-1) >= len(uv):
        return
    unit = bool(uv.min() >= 0 and uv.max() <= 1)
    check("UVs in 0..1", unit, f"{uv.min():.4f}..{uv.max():.4f}")
    if not unit:  # compiled code fills the texels of what follows and checks no bounds
        return
    a, b, c = (uv[faces[:, k]] for k in range(3))
    # v points down, so triangles that are counter-clockwise on the surface have negative area.
    area = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]))
    flipped = area > 1e-12
    tangent = asset.attributes.get("TANGENT")
    wrong = flipped if tangent is None else flipped & (tangent[faces][..., 3] > 0).any(1)
    check("no mirrored UVs against the tangents", not wrong.any(), f"{int(wrong.sum())} of {int(flipped.sum())} mirrored triangles")
    covered = float(np.abs(area).sum())
    if covered > MAX_COVERED:  # filling the texels of so many could take hours
        check("no overlapping UVs", False, f"the triangles cover {covered:.0f} times the square")
        return
    corners = np.stack([a, b, c])
    boxes = float(np.prod(corners.max(0) - corners.min(0), axis=1).sum())
    if boxes > MAX_BOXES:  # long oblique triangles, each of which is looked for in its whole box
        check("no overlapping UVs", True, "not looked at: many long oblique triangles", "info")
        return
    shared = overlapping(uv, faces, OVERLAP_SIZE)
    few = shared <= MAX_OVERLAP * covered * OVERLAP_SIZE**2
    passed = shared <= MAX_OVERLAP_SHARE * OVERLAP_SIZE**2
    check("no overlapping UVs", passed, f"{shared} of {OVERLAP_SIZE}² texels", "warning" if few else "error")
    check("UV space used", True, f"{covered:.0%} of the square", "info")


def _images(asset: GltfAsset, check: Any) -> None:
    """Rules of the textures: powers of two, PNG without colour chunks, other formats as the file says, packing, plausible values."""
    surface = asset.document["materials"][0].get("pbrMetallicRoughness", {}) if asset.document.get("materials") else {}
    factors = {"roughnessFactor", "metallicFactor"} <= surface.keys()
    present = "base_color" in asset.roles and ("orm" in asset.roles or factors)
    check("textures present", present, (", ".join(asset.roles) or "none") + (" and factors" if factors else ""))
    occlusion_only = "orm" not in asset.roles
    check("occlusion packed with roughness", occlusion_only or asset.roles.get("occlusion") in (None, asset.roles["orm"]), "one image")
    for role in ("base_color", "occlusion" if occlusion_only else "orm", "normal", "emissive"):
        if role not in asset.roles:
            continue
        content = asset.images[asset.roles[role]]
        form = image_format(content)
        if form == "png":
            width, height = _png_header(role, content, occlusion_only, check)
        elif form == "jpeg" or (form != "unknown" and _extension_of(form) in asset.document.get("extensionsRequired", [])):
            size = image_size(content, role)
            width, height = size.width, size.height
            check(f"{role}: image format", True, f"{width}x{height}, {form}")
        else:
            check(f"{role}: PNG", False, f"{form}: neither PNG, JPEG nor of an extension that the file requires")
            continue
        if not width:
            continue
        check(f"{role}: square power of two", width == height and width & (width - 1) == 0, f"{width}x{height}")
        check(f"{role}: usual size", USUAL_SIZES[0] <= width <= USUAL_SIZES[1], f"{width} texels", "info")
        pixels = asset.image(role)
        if pixels is None:
            continue
        if role == "base_color":
            outside = float(((pixels < PLAUSIBLE_COLOUR[0]) | (pixels > PLAUSIBLE_COLOUR[1])).mean())
            check("base colour within 30..243", outside < 0.05, f"{outside:.1%} of the values outside", "info")
        if role == "normal":
            share = non_unit_share(pixels)
            check("normal map of unit vectors", share < MAX_NON_UNIT, f"length error above 0.1 in {share:.2%} of the texels")
            inward = float((pixels[..., 2] < 128).mean())
            check("normal map points outwards", inward < 0.001, f"{inward:.2%} of the texels")


def non_unit_share(normal: NDArray[np.uint8]) -> float:
    """Share of the texels of a normal map (h, w, 3) whose vectors are off unit length by more than a tenth."""
    return float((np.abs(np.linalg.norm(normal / 127.5 - 1, axis=2) - 1) > 0.1).mean())


def _extension_of(form: str) -> str:
    return {"webp": "EXT_texture_webp", "ktx2": "KHR_texture_basisu"}[form]


def _png_header(role: str, content: bytes, occlusion_only: bool, check: Any) -> tuple[int, int]:
    """Check the header and the chunks of a PNG; its width and height, 0 where it is damaged."""
    chunks = png_chunks(content)
    if not chunks:
        check(f"{role}: PNG", False, "not a complete PNG file")
        return 0, 0
    width, height, depth, kind = struct.unpack_from(">IIBB", content, 16)
    colours, colour_type = ("grey", 0) if role == "occlusion" and occlusion_only else ("RGB", 2)
    check(f"{role}: 8-bit {colours} PNG", depth == 8 and kind == colour_type, f"{width}x{height}, {depth} bits, colour type {kind}")
    colour = [c for c in chunks if c in COLOUR_CHUNKS]
    check(f"{role}: no colour chunks", not colour, ", ".join(colour) or "none")
    return int(width), int(height)


def png_chunks(content: bytes) -> list[str]:
    """Names of a PNG's chunks in order; empty when the PNG is invalid or truncated."""
    if content[:8] != b"\x89PNG\r\n\x1a\n":
        return []
    names, offset = [], 8
    while offset + 8 <= len(content):
        size = struct.unpack_from(">I", content, offset)[0]
        names.append(content[offset + 4 : offset + 8].decode("latin-1"))
        offset += 12 + size
    return names if names and names[-1] == "IEND" and offset == len(content) else []
