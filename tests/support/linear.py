"""Linear shading from a function that shades pixels at given base colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gsbake.materials.linear_shading import LinearParts, LinearShading, Shader


def linear(shade: Callable[..., Any]) -> Shader:
    """The linear shading of `shade`, which takes a base colour, roughness (texels,) and metallic, and gives colours (n, 3)."""

    def shaded(roughness: Any) -> LinearParts:
        offsets = [shade(0.0, roughness, metallic) for metallic in (0.0, 1.0)]
        slopes = [shade(1.0, roughness, metallic) - offset for metallic, offset in zip((0.0, 1.0), offsets, strict=True)]
        return LinearParts(*map(LinearShading, slopes, offsets))

    return shaded
