"""Reader of GLB files for the report and the audit: the first mesh primitive, its material and its images.

Reads any GLB with float attributes and embedded images; it is not a general glTF library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.gltf.container import unpack_glb
from gsbake.gltf.document import COMPONENT_COUNTS, FAULTS, Document, check_structure, entry_of, reason_of, texture_infos, texture_source
from gsbake.imaging.encoded import decode_image
from gsbake.imaging.image_process import read_image
from gsbake.memory_budget import read_bytes

#: Bytes that a value of an attribute or a corner of a triangle takes, once it is read and while it is audited.
VALUE_BYTES = 32
WIDTHS = {"POSITION": 3, "NORMAL": 3, "TANGENT": 4, "TEXCOORD_0": 2}


@dataclass(frozen=True)
class GltfAsset:
    """Parsed content of a GLB.

    `document` is the JSON document; `attributes` maps names ("POSITION", …) to arrays (v, k); `faces` (f, 3) int64; `images` holds the
    encoded bytes of each image and `roles` the image index of each texture role that the material has ("base_color", "orm", "occlusion",
    "normal", "emissive"); `size` is the file size in bytes, `decode` what makes pixels of an image and its name.
    """

    document: dict[str, Any]
    attributes: dict[str, NDArray[Any]]
    faces: NDArray[np.int64]
    images: tuple[bytes, ...]
    roles: dict[str, int]
    size: int
    decode: Callable[[bytes, str], NDArray[np.uint8]]

    def image(self, role: str) -> NDArray[np.uint8] | None:
        """Pixels (h, w, 3) 8-bit RGB of a role's image as stored, or None when the material has none."""
        if role not in self.roles:
            return None
        return np.ascontiguousarray(self.decode(self.images[self.roles[role]], f"The {role} image of the asset")[..., :3])


def read_glb(path: Path) -> GltfAsset:
    """Read a GLB file. Raises BadInputError when it is damaged or holds no triangle mesh."""
    try:
        data = read_bytes(path)
    except OSError as error:
        raise BadInputError(f"'{path}' cannot be read: {error.strerror}.") from error
    return parse_glb(data, str(path), foreign=True)


def parse_glb(data: bytes, name: str, foreign: bool = False) -> GltfAsset:
    """Parse the bytes of a GLB; `name` identifies it in errors. The images of a `foreign` one are decoded in a child process.

    Raises BadInputError as `read_glb`.
    """
    document, binary = unpack_glb(data, name)
    fallback = [b""] * (len(document.get("buffers", [])) - 1) if isinstance(document.get("buffers"), list) else []
    file = Document(document, [binary, *fallback], name, None, len(data))
    try:
        check_structure(document)
        primitive = document["meshes"][0]["primitives"][0]
        read = [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]
        file.spend(sum(VALUE_BYTES * file.count(index) * COMPONENT_COUNTS[file.entry("accessors", index)["type"]] for index in read))
        attributes = {key: file.accessor(index) for key, index in primitive["attributes"].items()}
        if "indices" in primitive:
            corners = file.accessor(primitive["indices"])
            if corners.dtype.kind != "u":
                raise ValueError(f"its indices are of the type {corners.dtype}")
            faces = corners.astype(np.int64).reshape(-1, 3)
        else:
            faces = np.arange(len(attributes["POSITION"])).reshape(-1, 3)
        images = tuple(file.view(image["bufferView"]) for image in document.get("images", []))
        material = entry_of(document, "materials", primitive.get("material", 0)) if document.get("materials") else {}
        roles = _roles(document, material)
        _check_shapes(attributes, roles, len(images))
    except FAULTS as error:
        raise BadInputError(f"{name} holds no readable triangle mesh ({reason_of(error)}); export it again.") from error
    return GltfAsset(document, attributes, faces, images, roles, len(data), read_image if foreign else decode_image)


def _check_shapes(attributes: dict[str, NDArray[Any]], roles: dict[str, int], images: int) -> None:
    """Raise ValueError unless the attributes have the widths that glTF gives them, one row a vertex, and the roles name images."""
    for key, values in attributes.items():
        width = WIDTHS.get(key)
        if values.shape[:1] != attributes["POSITION"].shape[:1] or (width is not None and values.shape[1:] != (width,)):
            raise ValueError(f"{key} has the shape {values.shape}")
    if not len(attributes["POSITION"]):
        raise ValueError("it has no vertices")
    for role, index in roles.items():
        if not isinstance(index, int) or not 0 <= index < images:
            raise ValueError(f"the image of {role} does not exist")


def _roles(document: dict[str, Any], material: dict[str, Any]) -> dict[str, int]:
    """Image index of each texture role."""
    return {role: _image(document, texture["index"]) for role, texture in texture_infos(material).items()}


def _image(document: dict[str, Any], texture: int) -> int:
    """Index of the texture's image. Raises KeyError without one."""
    found = texture_source(document, texture)
    if found is None:
        raise KeyError("source")
    return found
