"""Linear shading from a function that shades pixels at given base colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gsbake.materials.linear_shading import LinearShading, Shader


def linear(shade: Callable[..., Any]) -> Shader:
    """The linear shading of `shade`, which takes a base colour, roughness (texels,) and metallic, and gives colours (n, 3)."""

    def shaded(roughness: Any, metallic: float) -> LinearShading:
        offset = shade(0.0, roughness, metallic)
        return LinearShading(shade(1.0, roughness, metallic) - offset, offset)

    return shaded
