"""The encoded images of a material, as the forms of a target take them that keep images in files of their own."""

from __future__ import annotations

from dataclasses import dataclass

from gsbake.gltf.write import GltfTextures
from gsbake.imaging.encoded import image_format

SUFFIXES = {"png": "png", "jpeg": "jpg"}


@dataclass(frozen=True)
class Images:
    """Encoded images of a material by role ("base_color", "orm", "normal", "emissive") with their files' suffixes; what is constant."""

    files: dict[str, tuple[bytes, str]]
    roughness: float | None = None
    metallic: float | None = None

    @staticmethod
    def of(textures: GltfTextures, factors: tuple[float, float] | None) -> Images:
        """The images of a material whose roughness and metallic are `factors`, or in the ORM image where that is None."""
        roles = {"base_color": textures.base_color, "orm": textures.orm, "normal": textures.normal, "emissive": textures.emissive}
        files = {role: (content, SUFFIXES[image_format(content)]) for role, content in roles.items() if content is not None}
        return Images(files) if factors is None else Images(files, *factors)
