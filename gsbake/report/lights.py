"""Environment lighting of the report's renders: the learnt map and two procedural ones, shaded by the split sum.

The procedural environments are functions of the direction in the asset's frame (+Y up), smooth enough for cube map faces of 32 texels. The
intensity gives white surfaces facing up or to the front a radiance near 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.report.render import Floats, Samples
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.split_sum import shade

Array = NDArray[np.float64]


def _lobe(directions: Array, towards: tuple[float, float, float], width: float) -> Array:
    """Spherical Gaussian lobe (n,) about the axis `towards`: 1 at the centre, standard deviation `width` in radians."""
    axis = np.array(towards) / np.linalg.norm(towards)
    return np.asarray(np.exp((directions @ axis - 1) / width**2))


def studio(directions: Array) -> Array:
    """Photo studio: warm key light from the upper right, cool fill light from the left, rim light, grey room. (n, 3) → (n, 3)."""
    room = 0.34 + 0.16 * directions[:, 1:2]
    key = _lobe(directions, (0.75, 0.8, 0.65), 0.36)[:, None] * np.array([5.4, 5.0, 4.5])
    fill = _lobe(directions, (-0.9, 0.35, 0.5), 0.42)[:, None] * np.array([1.0, 1.1, 1.25])
    rim = _lobe(directions, (-0.3, 0.6, -0.9), 0.25)[:, None] * np.array([3.2, 3.2, 3.2])
    return np.asarray(room + key + fill + rim)


def sunset(directions: Array) -> Array:
    """Sunset: low orange sun on the right, bright horizon, blue sky, dark ground. (n, 3) → (n, 3)."""
    up = directions[:, 1:2]
    horizon = np.exp(-np.abs(up) / 0.18) * (0.45 + 0.55 * _lobe(directions, (1.0, 0.1, 0.3), 0.9)[:, None])
    sky = np.array([0.22, 0.32, 0.60]) * (0.55 + 0.45 * up) + horizon * np.array([1.5, 0.70, 0.30])
    ground = np.array([0.10, 0.075, 0.06]) + 0.25 * horizon * np.array([1.0, 0.55, 0.3])
    share = 1 / (1 + np.exp(-up / 0.03))  # transition at the horizon, smooth enough for the cube map
    sun = _lobe(directions, (1.0, 0.22, 0.3), 0.14)[:, None] * np.array([34.0, 17.0, 6.5])
    return np.asarray(share * sky + (1 - share) * ground + sun)


#: {name in the report: radiance of directions (n, 3) in the asset's frame}.
PROCEDURAL_LIGHTS: dict[str, Callable[[Array], Array]] = {"Studio": studio, "Sunset": sunset}


class LitShader:
    """Split-sum shader under the environment map `light`; `to_light` (3, 3) rotates from the asset's frame to that of the map."""

    def __init__(self, light: EnvironmentLight, to_light: Array | None = None) -> None:
        self.light = light
        self.to_light = None if to_light is None else np.asarray(to_light, np.float32)
        with torch.no_grad():
            self._tables = light.prefilter()

    def __call__(self, samples: Samples) -> Floats:
        """Linear outgoing radiance (n, 3); ambient occlusion attenuates it as in a glTF viewer."""
        rotation = self.to_light
        normal, view = (v if rotation is None else v @ rotation.T for v in (samples.normal, samples.view))
        arrays = (normal, view, samples.base_color, samples.roughness, samples.metallic, samples.occlusion)
        n, v, base, rough, metal, occlusion = (torch.from_numpy(np.array(a, np.float32, order="C")) for a in arrays)
        with torch.no_grad():
            return np.asarray(shade(n, v, base, rough, metal, self._tables, occlusion).numpy())

    def equirectangular(self, height: int = 64) -> NDArray[np.float32]:
        """Equirectangular map (h, 2h, 3) of linear radiance in the asset's frame, in the layout of glTF viewers (three.js)."""
        return self.light.equirectangular(height, None if self.to_light is None else self.to_light.T, "gltf")


def procedural(name: str, size: int = 32) -> LitShader:
    """Shader of the environment `name` in PROCEDURAL_LIGHTS, as a cube map with faces of `size` texels."""
    return LitShader(EnvironmentLight.from_function(PROCEDURAL_LIGHTS[name], size))
