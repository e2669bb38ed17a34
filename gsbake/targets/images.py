"""Images within a budget: quality and size are stepped down until they fit.

Colours are what is seen first and keep their texels longest; roughness, metallic and normals lose precision and texels before them. Normals
are never subsampled in colour: JPEG keeps every channel at full resolution, WebP keeps them lossless at reduced precision.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbake.gltf.audit import MAX_NON_UNIT, non_unit_share
from gsbake.gltf.encode import Bytes, TextureMaps, reduce_precision
from gsbake.gltf.write import GltfTextures
from gsbake.imaging.encoded import decode_image
from gsbake.imaging.jpeg import encode_jpeg
from gsbake.imaging.ktx2 import encode_ktx2
from gsbake.imaging.png import encode_png

#: Smallest edge of a texture in texels.
MIN_EDGE = 64


@dataclass(frozen=True)
class Step:
    """One step: halvings and codec of colours, and of linear maps; a codec is (name, quality), for linear PNG and WebP the bits dropped."""

    colour: tuple[int, str, int]
    linear: tuple[int, str, int]

    @property
    def text(self) -> str:
        """The step in words."""
        parts = []
        for kind, (halvings, codec, quality) in (("colours", self.colour), ("linear maps", self.linear)):
            size = f" at 1/{2**halvings} of the edge" if halvings else ""
            detail = {"png": f" without {quality} low bits" if quality else "", "webp-lossless": f" without {quality} low bits"}.get(
                codec, "" if codec == "uastc" else f" quality {quality}"
            )
            parts.append(f"{kind} {codec}{detail}{size}")
        return ", ".join(parts)


def steps(form: str | None) -> Iterator[Step]:
    """The steps for PNG and JPEG (None), "webp" or "ktx2", from the best on; every round of them ends at half the edge."""
    halved = 0
    while True:
        match form:
            case None:
                if halved == 0:
                    yield Step((0, "png", 0), (0, "png", 0))
                    yield Step((0, "png", 0), (0, "png", 2))
                for quality in (96, 93, 90, 86, 82):
                    yield Step((halved, "jpeg", quality), (halved, "jpeg", quality))
                for quality in (90, 84, 78):
                    yield Step((halved, "jpeg", quality), (halved + 1, "jpeg", quality))
            case "webp":
                for quality, bits in ((96, 0), (94, 1), (92, 2), (88, 2), (84, 3)):
                    yield Step((halved, "webp", quality), (halved, "webp-lossless", bits))
                for quality in (86, 80):
                    yield Step((halved, "webp", quality), (halved + 1, "webp-lossless", 2))
            case _:
                yield Step((halved, "uastc", 100), (halved, "uastc", 100))
                yield Step((halved, "etc1s", 100), (halved, "uastc", 100))
                yield Step((halved, "etc1s", 90), (halved + 1, "uastc", 100))
        halved += 1


def fit_images(
    maps: Callable[[int], TextureMaps], edge: int, budget: int, form: str | None, check_stop: Callable[[], None] = lambda: None
) -> tuple[GltfTextures, Step, int]:
    """The images of `maps` (by edge) at the first step that fits into `budget` bytes in all, that step, and their edge.

    A step that leaves too few normals of unit length is passed over: JPEG of low quality changes it, half the edge at a better
    one does not.
    Where even textures of MIN_EDGE do not fit they are returned all the same.
    """
    encode = cache(lambda role, at, codec, quality: _encode(getattr(maps(at), role), role, codec, quality))

    @cache
    def unit(at: int, quality: int) -> bool:
        """Whether the normals are of unit length at this edge and quality of JPEG."""
        return non_unit_share(decode_image(encode("normal", at, "jpeg", quality), "normal map")[..., :3]) < MAX_NON_UNIT

    for step in steps(form):
        (hc, codec, quality), (hl, linear, amount) = step.colour, step.linear
        check_stop()
        have = maps(edge)
        colour_edge, linear_edge = max(MIN_EDGE, edge >> hc), max(MIN_EDGE, min(edge, len(have.orm)) >> hl)
        base = encode("base_color", colour_edge, codec, quality)
        emissive = None if have.emissive is None else encode("emissive", colour_edge, codec, quality)
        orm = encode("orm", linear_edge, linear, amount)
        normal = None if have.normal is None else encode("normal", linear_edge, linear, amount)
        fits = sum(len(image or b"") for image in (base, emissive, orm, normal)) <= budget
        if (fits and (normal is None or linear != "jpeg" or unit(linear_edge, amount))) or edge >> hc <= MIN_EDGE:
            break
    return GltfTextures(base, orm, normal, emissive), step, colour_edge


def _encode(image: Bytes, role: str, codec: str, quality: int) -> bytes:
    """One image by a codec."""
    match codec:
        case "png":
            return encode_png(reduce_precision(image, quality if role != "normal" else quality // 2))
        case "jpeg":
            return encode_jpeg(image, quality)
        case "webp":
            return _webp(image, quality=quality, method=6, use_sharp_yuv=True)
        case "webp-lossless":
            return _webp(reduce_precision(image, quality if role != "normal" else quality // 2), lossless=True, quality=80, method=4)
        case "etc1s" | "uastc":
            return encode_ktx2(image, "etc1s" if codec == "etc1s" else "uastc", quality, srgb=role in ("base_color", "emissive"))
    raise ValueError(f"there is no codec {codec}")


def _webp(image: NDArray[np.uint8], **options: object) -> bytes:
    content = io.BytesIO()
    rgb = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image
    Image.fromarray(rgb).save(content, "WEBP", exact=True, **options)
    return content.getvalue()
