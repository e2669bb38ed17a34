"""The asset in the page's 3D view, with its images in fewer bytes where the page would become too large to send or to open."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from gsbake.gltf.container import pack_glb, unpack_glb
from gsbake.imaging.encoded import decode_image
from gsbake.imaging.jpeg import encode_jpeg

#: Halvings of the images' edges and quality of JPEG, in turn.
STEPS = ((0, 92), (0, 85), (1, 90), (1, 80), (2, 85), (3, 85))


def page_model(data: bytes, budget: int) -> bytes:
    """The GLB `data`, or one of at most `budget` bytes with the same mesh and images in JPEG; the smallest where none is small enough.

    A file that this project did not write, with compressed or several buffers, stays as it is.
    """
    if len(data) <= budget:
        return data
    document, binary = unpack_glb(data, "asset.glb")
    views = document.get("bufferViews", [])
    if len(document.get("buffers", [])) != 1 or any("extensions" in view for view in views):
        return data
    smallest = data
    for halvings, quality in STEPS:
        smaller = _with_jpeg(document, binary, halvings, quality)
        smallest = min(smallest, smaller, key=len)
        if len(smallest) <= budget:
            break
    return smallest


def _with_jpeg(document: dict[str, Any], binary: bytes, halvings: int, quality: int) -> bytes:
    """The GLB with its images in JPEG of this quality, their edges halved so many times."""
    contents = [
        binary[start : start + view["byteLength"]] for view in document["bufferViews"] for start in [int(view.get("byteOffset", 0))]
    ]
    images = []
    for entry in document.get("images", []):
        if (view := entry.get("bufferView")) is None:
            images.append(entry)
            continue
        pixels = decode_image(contents[view], "asset.glb")[..., :3]
        height, width = (max(1, n >> halvings) for n in pixels.shape[:2])
        small = pixels if not halvings else np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        jpeg = encode_jpeg(small, quality)
        if len(jpeg) < len(contents[view]):
            contents[view], entry = jpeg, entry | {"mimeType": "image/jpeg"}
        images.append(entry)
    views, packed = [], b""
    for view, content in zip(document["bufferViews"], contents, strict=True):
        views.append(view | {"byteOffset": len(packed), "byteLength": len(content)})
        packed += content + b"\0" * (-len(content) % 4)
    return pack_glb(document | {"images": images, "bufferViews": views, "buffers": [{"byteLength": len(packed)}]}, packed)
