"""What the bake left: the unwrapped mesh and its textures as linear images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Similarity
from gsbake.gltf.write import GltfMesh
from gsbake.imaging.exr import read_exr


def load_mesh_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of `mesh.safetensors`."""
    try:
        arrays: dict[str, NDArray[Any]] = load_file(path)
    except (OSError, SafetensorError) as error:
        raise BadInputError(f"{path} cannot be read ({error}); bake again.") from error
    missing = {"position", "normal", "tangent", "uv", "faces"} - arrays.keys()
    if missing:
        raise BadInputError(f"{path} lacks {', '.join(sorted(missing))}; bake again.")
    fault = _fault(arrays)
    if fault:
        raise BadInputError(f"{path} holds {fault}; bake again.")
    return arrays


def _fault(arrays: dict[str, NDArray[Any]]) -> str:
    """What is wrong with the arrays of a mesh, or nothing."""
    faces, count = arrays["faces"], len(arrays["position"])
    for name, width in (("position", 3), ("normal", 3), ("tangent", 4), ("uv", 2)):
        if arrays[name].shape != (count, width):
            return f"{name} of shape {arrays[name].shape}"
        if not np.isfinite(arrays[name]).all():
            return f"{name} that is not finite"
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        return "no faces"
    if faces.min() < 0 or faces.max() >= count:
        return "faces of vertices that do not exist"
    return "uv outside the texture" if np.abs(arrays["uv"] - 0.5).max() > 0.5 + 1e-4 else ""


def read_texture(path: Path) -> NDArray[np.float32]:
    """The pixels of a baked texture, all of them finite."""
    image = read_exr(path)
    if not np.isfinite(image).all():
        raise BadInputError(f"{path} holds values that are not finite; bake again.")
    return image


def mesh_in_frame(arrays: dict[str, NDArray[Any]], frame: Similarity) -> GltfMesh:
    """The mesh in the asset frame; `frame` is a proper similarity, so handedness is preserved."""

    def rotated(vectors: NDArray[Any]) -> NDArray[np.float64]:
        out = vectors.astype(np.float64) @ frame.rotation.T
        return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)

    tangent = np.column_stack([rotated(arrays["tangent"][:, :3]), arrays["tangent"][:, 3]])
    return GltfMesh(
        frame.apply(arrays["position"].astype(np.float64)).astype(np.float32),
        rotated(arrays["normal"]).astype(np.float32),
        tangent.astype(np.float32),
        arrays["uv"].astype(np.float32),
        arrays["faces"].astype(np.int32),
    )
