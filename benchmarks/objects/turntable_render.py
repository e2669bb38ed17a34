"""Render a turntable in a cluttered room: object and disc turn, camera, room and lamps stand; the camera is moved between rounds.

PYTHON_WITH_BPY turntable_render.py ASSET.glb OUT --scorer DIR --hdri LIGHT --relight A B [--views N] [--rounds N] [--res W H] [...]

Takes the options of the scorer's `make_capture.py` and writes the same files: OUT/photos without masks and poses, and in OUT/gt the true
object, its cameras in the object's own frame (`train.json`), and reference views. The light reaches the room through its open ceiling.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

#: Half the side of the room, in sizes of the object; boxes, balls and cylinders in it.
ROOM, CLUTTER = 3.2, 90


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera to world, 4 × 4, OpenGL axes, +Z up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(right, forward), -forward, eye
    return pose


def turn(angle: float) -> np.ndarray:
    """Rotation about +Z, 4 × 4."""
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return pose


def patterned(name: str, rng: np.random.Generator, kind: str = "") -> bpy.types.Material:
    """A dielectric with a procedural texture, of a random kind unless one is given, in a few random colours or (`kind` "Cells") in many."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    kind = kind or str(rng.choice(["Voronoi", "Checker", "Wave", "Brick", "Noise"]))
    texture = nodes.new(f"ShaderNodeTex{'Voronoi' if kind == 'Cells' else kind}")
    texture.inputs["Scale"].default_value = float(rng.uniform(3, 14))
    if kind == "Noise":
        texture.inputs["Detail"].default_value = 8.0
    if kind in ("Noise", "Wave", "Voronoi"):
        ramp = nodes.new("ShaderNodeValToRGB")
        for element in ramp.color_ramp.elements:
            element.color = (*rng.uniform(0.03, 0.8, 3), 1.0)
        links.new(texture.outputs["Color"], ramp.inputs["Fac"])
        texture = ramp
    elif kind != "Cells":
        for colour in ("Color1", "Color2"):
            texture.inputs[colour].default_value = (*rng.uniform(0.03, 0.8, 3), 1.0)
    coordinates = nodes.new("ShaderNodeTexCoord")
    source = texture.inputs.get("Vector") or next(node for node in nodes if node.type.startswith("TEX_")).inputs["Vector"]
    links.new(coordinates.outputs["Object"], source)
    links.new(texture.outputs["Color"], surface.inputs["Base Color"])
    surface.inputs["Roughness"].default_value = float(rng.uniform(0.4, 0.9))
    return material


def root_of(item: bpy.types.Object) -> bpy.types.Object:
    """The object that has no parent and carries `item`."""
    while item.parent is not None:
        item = item.parent
    return item


def darken(objects: list[bpy.types.Object], factor: float) -> None:
    """Multiply the base colours of the objects by a factor, which glTF's exporter writes as that of the material."""
    for material in {slot.material for item in objects for slot in item.material_slots if slot.material}:
        nodes, links = material.node_tree.nodes, material.node_tree.links
        base = next(node for node in nodes if node.type == "BSDF_PRINCIPLED").inputs["Base Color"]
        base.default_value = tuple(factor * x for x in base.default_value[:3]) + (1.0,)
        for link in list(base.links):
            mix = nodes.new("ShaderNodeMix")
            mix.data_type, mix.blend_type = "RGBA", "MULTIPLY"
            mix.inputs[0].default_value, mix.inputs[7].default_value = 1.0, (factor, factor, factor, 1.0)
            links.new(link.from_socket, mix.inputs[6])
            links.new(mix.outputs[2], base)


def furnish(size: float, floor: float, rng: np.random.Generator) -> None:
    """Walls, floor and clutter around the turntable, which stands at the origin on a table of height `floor`."""
    half = ROOM * size
    for k in range(5):
        bpy.ops.mesh.primitive_plane_add(size=2 * half)
        wall = bpy.context.object
        upright = turn(k * math.pi / 2) @ np.array([[0, 0, -1, half], [0, 1, 0, 0], [1, 0, 0, floor + 0.4 * half], [0, 0, 0, 1.0]])
        level = np.eye(4) + np.pad([[floor - 0.6 * half]], ((2, 1), (3, 0)))
        wall.matrix_world = Matrix((upright if k < 4 else level).tolist())
        wall.data.materials.append(patterned(f"wall{k}", rng))
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, floor - 0.15 * size))
    bpy.context.object.scale = (2.2 * size, 1.8 * size, 0.1 * size)
    bpy.context.object.data.materials.append(patterned("table", rng))
    for k in range(CLUTTER):
        angle, distance = rng.uniform(1.4, 2 * math.pi - 0.6), rng.uniform(1.2, 0.9 * ROOM) * size  # not before the camera
        extent = rng.uniform(0.08, 0.35, 3) * size
        place = (distance * math.cos(angle), distance * math.sin(angle), floor + rng.uniform(-0.5, 1.2) * size)
        add = [bpy.ops.mesh.primitive_cube_add, bpy.ops.mesh.primitive_uv_sphere_add, bpy.ops.mesh.primitive_cylinder_add][k % 3]
        add(location=place, rotation=tuple(rng.uniform(0, 3, 3)))
        bpy.context.object.scale = tuple(extent)
        bpy.context.object.data.materials.append(patterned(f"clutter{k}", rng))


def main() -> None:
    """Render photos, truth and reference views."""
    parser = argparse.ArgumentParser()
    parser.add_argument("asset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scorer", type=Path, required=True)
    parser.add_argument("--hdri", type=Path, required=True)
    parser.add_argument("--relight", type=Path, nargs="+", required=True)
    parser.add_argument("--views", type=int, default=54)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--res", type=int, nargs=2, default=(800, 600))
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--test-views", type=int, default=4)
    parser.add_argument("--test-res", type=int, default=240)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--dark", type=float, default=1.0, help="factor on the base colours of the object")
    options = parser.parse_args()
    sys.path.insert(0, str(options.scorer))
    import blender_render as scorer

    rng, size, resolution = np.random.default_rng(options.seed), 2.0, tuple(options.res)
    truth, photos = options.out / "gt", options.out / "photos"
    (truth / "hdri").mkdir(parents=True, exist_ok=True)
    photos.mkdir(parents=True, exist_ok=True)
    scorer.reset(resolution, options.samples)
    corners = np.array([(o.matrix_world @ Vector(c))[:] for o in scorer.load_asset(options.asset) for c in o.bound_box])
    low, high = corners.min(0), corners.max(0)
    fit = np.diag([*[size / np.linalg.norm(high - low)] * 3, 1.0])
    fit[:3, 3] = -fit[0, 0] * (low + high) / 2
    scorer.reset(resolution, options.samples)
    darken(scorer.load_asset(options.asset, fit), options.dark)
    bpy.ops.export_scene.gltf(filepath=str(truth / "asset.glb"), export_format="GLB", use_selection=False)
    for light in options.relight:
        shutil.copy(light, truth / "hdri" / light.name)

    focal = 0.5 * resolution[0] / math.tan(math.radians(20))
    names, poses, cameras, turns = [], [], [], []
    per_round = options.views // options.rounds
    for round_, elevation in enumerate(np.linspace(12, 55, options.rounds)):
        height, azimuth = math.radians(elevation), 0.4 * round_  # the tripod is moved aside too
        distance = size * (1.9 + 0.15 * rng.uniform(-1, 1))
        eye = distance * np.array([math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)])
        camera = look_at(eye, rng.normal(0, 0.03, 3))
        for k in range(per_round):
            angle = 2 * math.pi * (k + rng.uniform(-0.05, 0.05)) / per_round
            names.append(f"{len(names):04d}.jpg")
            cameras.append(camera)
            turns.append(angle)
            poses.append(turn(-angle) @ camera)
    (truth / "train.json").write_text(
        json.dumps({"w": resolution[0], "h": resolution[1], "fl_x": focal, "names": names, "c2w": [p.tolist() for p in poses]})
    )
    scale = options.test_res / resolution[0]
    tests = [turn(1.1 + 2.4 * k) @ poses[(5 * k) % len(poses)] for k in range(options.test_views)]
    views = {"w": options.test_res, "h": round(resolution[1] * scale), "fl_x": focal * scale, "c2w": [p.tolist() for p in tests]}
    (truth / "views.json").write_text(json.dumps(views))

    scorer.reset(resolution, options.samples)
    objects = scorer.load_asset(truth / "asset.glb")
    floor = min((o.matrix_world @ Vector(c))[2] for o in objects for c in o.bound_box)
    furnish(size, floor, rng)
    bpy.ops.mesh.primitive_cylinder_add(vertices=96, radius=0.55 * size, depth=0.06 * size, location=(0, 0, floor - 0.03 * size))
    disc = bpy.context.object
    disc.data.materials.append(patterned("disc", rng, "Cells"))  # nothing repeats on it
    table = bpy.data.objects.new("turntable", None)
    bpy.context.scene.collection.objects.link(table)
    for moved in {disc, *map(root_of, objects)}:
        pose = moved.matrix_world.copy()
        moved.parent, moved.matrix_world = table, pose
    scorer.set_environment(options.hdri)
    scene = bpy.context.scene
    scene.render.film_transparent = False
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces = 2, 1
    for name, camera, angle in zip(names, cameras, turns, strict=True):
        table.matrix_world = Matrix(turn(angle).tolist())
        bpy.context.view_layer.update()
        scorer.set_camera(camera, focal, resolution)
        scorer.render_to(photos / f"{Path(name).stem}.png")
    from PIL import Image

    for path in sorted(photos.glob("*.png")):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Render", "Cycles 36mm"
        lens = exif.get_ifd(0x8769)
        lens[0x920A], lens[0xA405] = focal * 36.0 / resolution[0], round(focal * 36.0 / resolution[0])
        Image.open(path).convert("RGB").save(path.with_suffix(".jpg"), quality=94, subsampling=0, exif=exif)
        path.unlink()
    lights = [truth / "hdri" / light.name for light in options.relight]
    scorer.render_views(truth / "asset.glb", views, truth / "ref", lights, scorer.CHANNELS, samples=128)


if __name__ == "__main__":
    main()
