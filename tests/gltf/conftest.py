"""A small valid asset to write, read and break."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from gsbake.geometry.tangents import tangents
from gsbake.gltf.write import GltfMesh, GltfTextures, build_glb
from gsbake.imaging.png import encode_png
from gsbake.texturing.atlas import make_atlas

EXTRAS = {"scale": "unknown"}


@pytest.fixture(scope="session")
def mesh() -> GltfMesh:
    ball = trimesh.creation.icosphere(subdivisions=2)
    points, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    atlas = make_atlas(points, faces, 128)
    position = points[atlas.source]
    frames = tangents(position, position, atlas.uv, atlas.faces)
    return GltfMesh(*(np.asarray(a, np.float32) for a in (2 * position, position, frames.tangent, atlas.uv)), frames.faces)


@pytest.fixture(scope="session")
def images() -> GltfTextures:
    rng = np.random.default_rng(0)
    base = rng.integers(60, 200, (128, 128, 3), dtype=np.uint8)
    flat = np.tile(np.array([128, 128, 255], np.uint8), (128, 128, 1))
    orm = np.tile(np.array([250, 180, 0], np.uint8), (128, 128, 1))
    return GltfTextures(encode_png(base), encode_png(orm), encode_png(flat))


@pytest.fixture(scope="session")
def glb(mesh: GltfMesh, images: GltfTextures) -> bytes:
    return build_glb(mesh, images, "ball", "gsbake test", "me", EXTRAS)
