"""Lights for the report's renders: the learnt environment, and two procedural ones that lit no photo, all shaded by the split sum.

The procedural lights are functions of the direction in the asset's frame (+Y up), smooth enough for a cube map of 32 texels. Their level is
set so that white surfaces that face up or the front come out near 1.
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
    """A smooth lamp (n,): 1 in its middle, falling off like a Gaussian of `width` radians."""
    axis = np.array(towards) / np.linalg.norm(towards)
    return np.asarray(np.exp((directions @ axis - 1) / width**2))


def studio(directions: Array) -> Array:
    """Photo studio: a warm soft box from the upper right, a cool one from the left, a rim light, a grey room. (n, 3) → (n, 3)."""
    room = 0.34 + 0.16 * directions[:, 1:2]
    key = _lobe(directions, (0.75, 0.8, 0.65), 0.36)[:, None] * np.array([5.4, 5.0, 4.5])
    fill = _lobe(directions, (-0.9, 0.35, 0.5), 0.42)[:, None] * np.array([1.0, 1.1, 1.25])
    rim = _lobe(directions, (-0.3, 0.6, -0.9), 0.25)[:, None] * np.array([3.2, 3.2, 3.2])
    return np.asarray(room + key + fill + rim)


def sunset(directions: Array) -> Array:
    """Open land at sunset: a low orange sun at the right, a glowing horizon, blue above, dark ground. (n, 3) → (n, 3)."""
    up = directions[:, 1:2]
    glow = np.exp(-np.abs(up) / 0.18) * (0.45 + 0.55 * _lobe(directions, (1.0, 0.1, 0.3), 0.9)[:, None])
    sky = np.array([0.22, 0.32, 0.60]) * (0.55 + 0.45 * up) + glow * np.array([1.5, 0.70, 0.30])
    ground = np.array([0.10, 0.075, 0.06]) + 0.25 * glow * np.array([1.0, 0.55, 0.3])
    share = 1 / (1 + np.exp(-up / 0.03))  # the horizon, soft enough for the cube map
    sun = _lobe(directions, (1.0, 0.22, 0.3), 0.14)[:, None] * np.array([34.0, 17.0, 6.5])
    return np.asarray(share * sky + (1 - share) * ground + sun)


#: Name in the report → radiance of directions in the asset's frame.
PROCEDURAL: dict[str, Callable[[Array], Array]] = {"Studio": studio, "Sunset": sunset}


class LitShader:
    """Shades samples by the split sum under `light`; `to_light` (3, 3) turns directions of the asset's frame into those of the light's."""

    def __init__(self, light: EnvironmentLight, to_light: Array | None = None) -> None:
        self.light = light
        self.to_light = None if to_light is None else np.asarray(to_light, np.float32)
        with torch.no_grad():
            self._tables = light.prefilter()

    def __call__(self, samples: Samples) -> Floats:
        """Linear radiance towards the eye (n, 3); occlusion darkens as in a glTF viewer."""
        turn = self.to_light
        normal, view = (v if turn is None else v @ turn.T for v in (samples.normal, samples.view))
        arrays = (normal, view, samples.base_color, samples.roughness, samples.metallic, samples.occlusion)
        n, v, base, rough, metal, open_share = (torch.from_numpy(np.array(a, np.float32, order="C")) for a in arrays)
        with torch.no_grad():
            return np.asarray(shade(n, v, base, rough, metal, self._tables, open_share).numpy())

    def equirectangular(self, height: int = 64) -> NDArray[np.float32]:
        """The light as glTF viewers (three.js) read it: (h, 2h, 3) linear radiance in the asset's frame."""
        return self.light.equirectangular(height, None if self.to_light is None else self.to_light.T, "gltf")


def procedural(name: str, size: int = 32) -> LitShader:
    """The shader of a procedural light by its name in PROCEDURAL, as a cube map with faces of `size` texels."""
    return LitShader(EnvironmentLight.from_function(PROCEDURAL[name], size))
