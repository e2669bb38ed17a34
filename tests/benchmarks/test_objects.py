"""The procedural test models: textures hold the materials that the procedures define."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from benchmarks.objects.models import MODELS, Material, model_glb
from gsbake.imaging.srgb import decode


def test_textures_hold_the_material_of_each_position() -> None:
    """A short cylinder: copper above, rough green below, a lamp at the top."""

    def procedure(p: np.ndarray) -> Material:
        copper = Material.uniform(len(p), (0.9, 0.6, 0.5), 0.3, 1.0)
        green = Material.uniform(len(p), (0.1, 0.4, 0.2), 0.8)
        lamp = Material(np.full((len(p), 3), 0.02), np.full(len(p), 0.5), np.zeros(len(p)), np.tile([0.0, 0.5, 1.0], (len(p), 1)))
        return copper.blend(green, (p[:, 2] < 0.5).astype(float)).blend(lamp, (p[:, 2] > 0.9).astype(float))

    glb = model_glb(trimesh.creation.cylinder(0.5, segment=[[0, 0, 0], [0, 0, 1]], sections=24).subdivide().subdivide(), procedure, 256)
    mesh = trimesh.load(io.BytesIO(glb), file_type="glb", force="mesh", process=False)
    height = np.asarray(mesh.vertices)[:, 1]  # +Y up
    assert height.min() == pytest.approx(0, abs=1e-6) and height.max() == pytest.approx(1, abs=1e-6)
    material = mesh.visual.material
    base, orm, emission = (np.asarray(image.convert("RGB")) / 255 for image in (
        material.baseColorTexture, material.metallicRoughnessTexture, material.emissiveTexture))  # fmt: skip
    centre, uv = mesh.triangles_center[:, 1], np.asarray(mesh.visual.uv)[mesh.faces].mean(1)
    row, column = ((1 - uv[:, 1]) * 256).astype(int), (uv[:, 0] * 256).astype(int)
    side = np.abs(mesh.face_normals[:, 1]) < 0.1
    upper, lower, top = side & (centre > 0.55) & (centre < 0.85), side & (centre < 0.45), centre > 0.99
    assert upper.sum() > 20 and lower.sum() > 20 and top.sum() > 20
    np.testing.assert_allclose(decode(base[row, column][upper]), np.tile([0.9, 0.6, 0.5], (upper.sum(), 1)), atol=0.01)
    np.testing.assert_allclose(orm[row, column][upper, 1:], np.tile([0.3, 1.0], (upper.sum(), 1)), atol=0.005)
    np.testing.assert_allclose(orm[row, column][lower, 1:], np.tile([0.8, 0.0], (lower.sum(), 1)), atol=0.005)
    np.testing.assert_allclose(decode(emission[row, column][top]), np.tile([0.0, 0.5, 1.0], (top.sum(), 1)), atol=0.01)


@pytest.mark.parametrize("name", MODELS)
def test_models_have_valid_materials(name: str) -> None:
    shape, procedure = MODELS[name]
    mesh = shape()
    points = np.asarray(mesh.vertices)[:: max(1, len(mesh.vertices) // 2000)]
    material = procedure(points)
    assert material.base.shape == (len(points), 3) and material.base.min() >= 0 and material.base.max() <= 1
    assert material.roughness.min() >= 0.05 and material.roughness.max() <= 1
    assert material.metallic.min() >= 0 and material.metallic.max() <= 1
    assert mesh.is_winding_consistent and mesh.volume > 0
