"""Draw spheres under an even white light in Blender's Cycles; its interpreter has bpy, and it knows nothing of gsbake.

PYTHON furnace_render.py JOB.json with {"out", "size", "samples", "materials": [[base colour, roughness, metallic], …]}. Writes out/<k>.exr:
linear radiance of a sphere that fills the picture, seen from far away.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy


def draw(base: float, roughness: float, metallic: float, size: int, samples: int, out: Path) -> None:
    """One sphere."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = samples, False
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.view_settings.view_transform = "Raw"
    bpy.ops.mesh.primitive_uv_sphere_add(segments=256, ring_count=128, radius=1)
    bpy.ops.object.shade_smooth()
    material = bpy.data.materials.new("surface")
    material.use_nodes = True
    inputs = material.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (base, base, base, 1)
    inputs["Roughness"].default_value, inputs["Metallic"].default_value, inputs["IOR"].default_value = roughness, metallic, 1.5
    bpy.context.object.data.materials.append(material)
    scene.world = bpy.data.worlds.new("even")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.ortho_scale = "ORTHO", 2.0
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.camera.location = (0, 0, 5)
    scene.collection.objects.link(scene.camera)
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(out)
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Draw all spheres of the job."""
    job = json.loads(Path(sys.argv[1]).read_text())
    for k, material in enumerate(job["materials"]):
        draw(*material, job["size"], job["samples"], Path(job["out"]) / f"{k}.exr")


if __name__ == "__main__":
    main()
