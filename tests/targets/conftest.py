"""A small baked asset without a bake: an unwrapped bumpy ball with analytic maps, its dense mesh, cameras and exported GLB."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from safetensors.numpy import save_file

from gsbake.config.schema import Export
from gsbake.geometry.cameras import CameraSet, Similarity
from gsbake.geometry.ply import write_mesh
from gsbake.geometry.tangents import tangents, world_to_frame
from gsbake.gltf.export import ExportOptions, export_asset
from gsbake.gltf.write import GltfMesh
from gsbake.imaging.exr import write_exr
from gsbake.surfels.model import create
from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.inpainting import fill_empty_texels
from gsbake.texturing.normal_map import vertex_normals
from gsbake.texturing.texels import rasterise
from tests.support.cameras import look_at

EDGE = 128
#: Unit frame to world.
TO_WORLD = Similarity(1.5, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.2, 0.1, 0.4]))


def bumpy(direction: np.ndarray) -> np.ndarray:
    """Radius of the ball in a direction."""
    return 0.8 * (1 + 0.04 * np.sin(5 * direction[:, 0] + 1) * np.cos(4 * direction[:, 1]))


def colour(position: np.ndarray) -> np.ndarray:
    """Linear base colour at a point."""
    return 0.4 + 0.25 * position


def ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    direction = np.asarray(shape.vertices)
    return direction * bumpy(direction)[:, None], np.asarray(shape.faces)


@pytest.fixture(scope="session")
def unwrapped() -> GltfMesh:
    """The ball of 1280 triangles in the unit frame."""
    points, faces = ball(3)
    atlas = make_atlas(points, faces, EDGE)
    position, normal = points[atlas.source], vertex_normals(points, faces)[atlas.source]
    frames = tangents(position, normal, atlas.uv, atlas.faces)
    source = frames.source
    arrays = position[source], normal[source], frames.tangent, atlas.uv[source]
    return GltfMesh(*(np.asarray(array, np.float32) for array in arrays), frames.faces)


@pytest.fixture(scope="session")
def folders(unwrapped: GltfMesh, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Artifact folders of the stages that targets read."""
    root = tmp_path_factory.mktemp("baked")
    out = {name: root / name for name in ("ingest", "poses", "refine", "mesh", "bake", "export")}
    for folder in out.values():
        folder.mkdir()
    write_mesh(out["mesh"] / "dense.ply", *ball(5))
    texels = rasterise(unwrapped.uv, unwrapped.faces, EDGE)
    position, normal, tangent = (texels.interpolate(v, unwrapped.faces) for v in (unwrapped.position, unwrapped.normal, unwrapped.tangent))
    direction = position / np.linalg.norm(position, axis=1, keepdims=True)
    step = 1e-4
    slope = np.stack([(bumpy(_unit(direction + step * e)) - bumpy(_unit(direction - step * e))) / (2 * step) for e in np.eye(3)], 1)
    true = _unit(direction - slope / bumpy(direction)[:, None])
    maps = {
        "base_color": colour(position),
        "orm": np.stack([np.full(len(position), 0.9), 0.5 + 0.3 * direction[:, 2], np.where(direction[:, 0] > 0.5, 1.0, 0.0)], 1),
        "normal": 0.5 + 0.5 * world_to_frame(true, normal, tangent),
    }
    for name, values in maps.items():
        write_exr(out["bake"] / f"{name}.exr", fill_empty_texels(texels.image(values), texels.covered(), 2))
    body = {name: np.ascontiguousarray(getattr(unwrapped, name), np.float32) for name in ("position", "normal", "tangent", "uv")}
    save_file(body | {"faces": np.ascontiguousarray(unwrapped.faces, np.int32)}, out["bake"] / "mesh.safetensors")
    around = [(2.4, 0.3, 0.8), (-2.4, 0.1, 0.5), (0.2, 2.4, 0.7), (0.1, -2.4, 0.9), (0.3, 0.2, 2.5), (0.3, -0.2, -2.5)]
    cameras = tuple(look_at(np.array(c), size=64, focal=80.0, name=f"p{i}") for i, c in enumerate(around))
    CameraSet(cameras, TO_WORLD, "given", metric=True).save(out["poses"] / "cameras.json")
    (out["poses"] / "photos").mkdir()
    (out["ingest"] / "photos.json").write_text(json.dumps({"photos": [{"name": c.name, "source": f"{c.name}.jpg"} for c in cameras]}))
    export_asset(out["ingest"], out["poses"], out["refine"], out["bake"], out["export"], ExportOptions(Export()))
    points = ball(2)[0]
    surfels = create(points, _unit(points), np.full(len(points), 0.1), np.clip(colour(points), 0, 1), "colour", 1, 0.0, 20.0)
    surfels.save(out["refine"] / "surfels.safetensors")
    return out


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
