"""Any glTF file is read with its nodes, and refused in one sentence where it cannot be honoured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsbake.errors import BadInputError
from gsbake.gltf.scene import TextureUse, open_scene
from gsbake.viewing.inspect import inspect_file
from tests.support.gltf_files import two_triangles


def test_nodes_place_their_meshes(gltf: Path) -> None:
    """The second instance is twice as large and moved; flat normals point along the winding."""
    scene = open_scene(gltf)
    assert scene.faces.shape == (2, 3)
    np.testing.assert_allclose(scene.parts[1].position, [[3, 0, 0], [5, 0, 0], [3, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(scene.normals, np.tile([0, 0, 1], (6, 1)), atol=1e-7)
    assert scene.materials[0].base_color == (1, 0, 0, 1)


def test_a_mirrored_node_keeps_its_outside(tmp_path: Path) -> None:
    """A negative scale turns the winding, so that the front stays where the normal points."""
    path = tmp_path / "mirror.gltf"
    path.write_text(json.dumps(two_triangles(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}], scenes=[{"nodes": [0]}])))
    part = open_scene(path).parts[0]
    corner = part.position[part.faces[0]]
    assert np.cross(corner[1] - corner[0], corner[2] - corner[0])[2] > 0


def test_texture_transform() -> None:
    """KHR_texture_transform: scale, then a rotation counter-clockwise in the image, then the offset (values from its specification)."""
    c, s = np.cos(np.pi / 2), np.sin(np.pi / 2)
    use = TextureUse(0, 0, np.array([[c * 2, s * 3, 0.5], [-s * 2, c * 3, 0.25]]), (10497, 10497))
    np.testing.assert_allclose(use.coordinates(np.array([[1, 0], [0, 1]], np.float32)), [[0.5, -1.75], [3.5, 0.25]], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "needs KHR_draco_mesh_compression"),
        ({"buffers": [{"byteLength": 36, "uri": "../secret.bin"}]}, "not in its folder"),
        ({"buffers": [{"byteLength": 36, "uri": "/dev/zero"}]}, "not in its folder"),
        ({"buffers": [{"byteLength": 36, "uri": "https://example.org/x.bin"}]}, "not a file beside it"),
        ({"nodes": [{"mesh": 0, "children": [0]}], "scenes": [{"nodes": [0]}]}, "no tree"),
        ({"accessors": [{"componentType": 5126, "count": 10**12, "type": "VEC3"}]}, "triangles, more than"),
        ({"meshes": [{"primitives": []}]}, "no triangles"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 7}}]}]}, "not a valid glTF file"),
    ],
)
def test_wrong_files_are_refused_in_one_sentence(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    """Compressed files, files elsewhere and malformed documents."""
    path = tmp_path / "folder" / "wrong.gltf"
    path.parent.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(36))
    path.write_text(json.dumps(two_triangles(**changes)))
    with pytest.raises(BadInputError, match=message) as caught:
        open_scene(path)
    assert "\n" not in str(caught.value)


def test_inspect_counts_what_is_there(ball: Path, gltf: Path) -> None:
    """Triangles, textures and sizes of files that gsbake did not write."""
    found = inspect_file(ball)
    assert found["container"] == "GLB" and found["bytes"] == ball.stat().st_size
    assert [(t["roles"], t["width"], t["format"]) for t in found["textures"]] == [(["base_color"], 16, "png")]
    np.testing.assert_allclose(found["bounds"]["size"], [2, 2, 2], atol=0.02)
    assert any(not finding["passed"] for finding in found["audit"])  # it has no normal map
    other = inspect_file(gltf)
    assert (other["container"], other["triangles"], other["generator"], other["audit"]) == ("glTF", 2, "hand", [])
