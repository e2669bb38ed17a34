"""The light of renders of any file: a procedural environment of the report, or an equirectangular HDR image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsbake.errors import UsageError
from gsbake.imaging.image_process import read_light
from gsbake.report.lights import PROCEDURAL_LIGHTS, LitShader, procedural
from gsbake.shading.environment import EnvironmentLight

#: Texels along a face of the cube map made from an image.
FACE_SIZE = 64
#: Name of the light beside a file, as the export writes it.
LIGHT_FILE = "light.hdr"


def light_files(light: str, beside: Path) -> tuple[Path, ...]:
    """The file of a light as `load_light` takes it; none of a procedural one."""
    if light.lower() in map(str.lower, PROCEDURAL_LIGHTS):
        return ()
    return (beside / LIGHT_FILE if light == "hdr" else Path(light),)


def load_light(light: str, beside: Path) -> LitShader:
    """Shader under `light`: "studio", "sunset", "hdr" (`light.hdr` in the folder `beside`) or the path of an HDR or EXR image.

    Raises UsageError for an unknown name, BadInputError for an image that cannot be read.
    """
    named = {name.lower(): name for name in PROCEDURAL_LIGHTS}
    if light.lower() in named:
        return procedural(named[light.lower()])
    (path,) = light_files(light, beside)
    if not path.is_file():
        if light == "hdr":
            raise UsageError(f"There is no {LIGHT_FILE} in '{beside}'; name an HDR image with --light, or use --light studio.")
        raise UsageError(f"The light '{light}' is neither {', '.join(named)} or hdr nor an image.")
    image = np.maximum(read_light(path), 0).astype(np.float64)
    return LitShader(EnvironmentLight.from_equirectangular(image, FACE_SIZE, convention="gltf"))
