"""Draw an asset in Blender from given cameras under an equirectangular light; its interpreter has bpy, and it knows nothing of gsbake.

PYTHON blender_render.py JOB.json with {"asset", "light", "out", "samples", "views": [{"name", "width", "height", "focal", "cx", "cy",
"matrix": camera to asset, OpenGL axes, glTF frame}]}. Writes out/<name>.exr: linear RGBA, premultiplied.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

#: glTF (+Y up) to Blender (+Z up), as Blender's importer converts.
UP = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def main() -> None:
    """Render every view of the job."""
    job = json.loads(Path(sys.argv[-1]).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=job["asset"])
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = job["samples"], True, 0
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.image_settings.color_mode = "RGBA"
    scene.world = bpy.data.worlds.new("light")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = bpy.data.images.load(job["light"])
    links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.data.sensor_fit, camera.data.sensor_width, camera.data.clip_start, camera.data.clip_end = "HORIZONTAL", 36.0, 1e-4, 1e5
    for view in job["views"]:
        width, height = view["width"], view["height"]
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
        camera.data.lens = view["focal"] * 36.0 / width
        camera.data.shift_x, camera.data.shift_y = (width / 2 - view["cx"]) / width, (view["cy"] - height / 2) / width
        camera.matrix_world = UP @ Matrix(view["matrix"])
        scene.render.filepath = str(Path(job["out"]) / f"{view['name']}.exr")
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
