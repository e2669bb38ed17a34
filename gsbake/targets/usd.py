"""USD with UsdPreviewSurface: a USDC file with its images beside it, or a USDZ package that ARKit opens (extra `usd`).

+Y up, metres where the scale is known. Texture coordinates have their origin at the bottom left; the normal map is scaled to −1..1; base
colour and emission are sRGB, the others raw. OpenUSD, *UsdPreviewSurface specification* 2.6; Apple, *Creating USD files for Apple devices*.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gsbake.errors import BadInputError
from gsbake.gltf.write import GltfMesh
from gsbake.targets.material_images import Images

#: {input of the surface: (image, its output, kind)}; the kinds are names of Sdf types.
INPUTS = {
    "diffuseColor": ("base_color", "rgb", "Color3f"),
    "occlusion": ("orm", "r", "Float"),
    "roughness": ("orm", "g", "Float"),
    "metallic": ("orm", "b", "Float"),
    "normal": ("normal", "rgb", "Normal3f"),
    "emissiveColor": ("emissive", "rgb", "Color3f"),
}
#: Time of the files in a package, in seconds: the first day that a zip archive knows.
TIME = 315_576_000
#: Images that hold colours; the others hold data.
COLOURS = ("base_color", "emissive")


def write_usd(out: Path, stem: str, mesh: GltfMesh, images: Images, *, package: bool, metric: bool) -> list[str]:
    """Write `stem`.usdz, or `stem`.usdc and its images, into `out`; the names of the files, the main one first."""
    from pxr import Sdf, UsdUtils

    with tempfile.TemporaryDirectory(dir=out) as scratch:
        folder = Path(scratch) if package else out
        names = {role: f"{stem}_{role}.{suffix}" for role, (_, suffix) in images.files.items()}
        for role, (content, _) in images.files.items():
            (folder / names[role]).write_bytes(content)
        layer = folder / f"{stem}.usdc"
        _write_stage(layer, mesh, images, names, metric)
        if not package:
            return [layer.name, *names.values()]
        target = out / f"{stem}.usdz"
        for file in folder.iterdir():
            os.utime(file, (TIME, TIME))  # which the package records: equal input gives equal bytes
        if not UsdUtils.CreateNewARKitUsdzPackage(Sdf.AssetPath(str(layer)), str(target)):
            raise BadInputError(f"{target.name} cannot be packed; take the form usdc instead.")
    return [target.name]


def _write_stage(path: Path, mesh: GltfMesh, images: Images, names: dict[str, str], metric: bool) -> None:
    """One Xform with one mesh and its material."""
    from pxr import Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/asset")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    if not metric:
        root.GetPrim().SetCustomDataByKey("scale", "unknown")
    body = UsdGeom.Mesh.Define(stage, "/asset/mesh")
    position = np.ascontiguousarray(mesh.position, np.float32)
    body.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(position))
    body.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([position.min(0), position.max(0)])))
    body.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    body.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).ravel()))
    body.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    body.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.normal, np.float32)))
    body.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    uv = np.ascontiguousarray(np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], 1), np.float32)
    coordinates = UsdGeom.PrimvarsAPI(body).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(uv))
    material = _material(stage, images, names)
    UsdShade.MaterialBindingAPI.Apply(body.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()


def _material(stage: Any, images: Images, names: dict[str, str]) -> Any:
    """The material of a stage."""
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, "/asset/material")
    surface = UsdShade.Shader.Define(stage, "/asset/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", types.Int).Set(0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    reader = UsdShade.Shader.Define(stage, "/asset/material/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    reader.CreateOutput("result", types.Float2)
    textures: dict[str, Any] = {}
    for role, name in names.items():
        texture = UsdShade.Shader.Define(stage, f"/asset/material/{role}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{name}"))
        texture.CreateInput("sourceColorSpace", types.Token).Set("sRGB" if role in COLOURS else "raw")
        for axis in ("wrapS", "wrapT"):
            texture.CreateInput(axis, types.Token).Set("clamp")
        if role == "normal":
            texture.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            texture.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        texture.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        textures[role] = texture
    constants = {"roughness": images.roughness, "metallic": images.metallic}
    for key, (role, output, kind) in INPUTS.items():
        entry = surface.CreateInput(key, getattr(types, kind))
        if constants.get(key) is not None:
            entry.Set(float(constants[key] or 0.0))
        elif role in textures:
            textures[role].CreateOutput(output, types.Float if output in "rgb" and len(output) == 1 else types.Float3)
            entry.ConnectToSource(textures[role].ConnectableAPI(), output)
        else:
            surface.GetPrim().RemoveProperty(f"inputs:{key}")
    return material
