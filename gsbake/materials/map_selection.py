"""Which material maps are needed: metallic and roughness are replaced by constants where validation views are reproduced as well.

Photos of a diffuse object hardly determine either, so per-texel values are mostly noise, which another environment makes visible.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsbake.materials.materials import Materials
from gsbake.materials.passes import Decide, Scene
from gsbake.materials.photo import texel_weight
from gsbake.materials.state import State

Floats = NDArray[np.float32]

#: PSNR in dB of validation views with some materials; None without views.
Psnr = Callable[[Materials], float | None]


@dataclass(frozen=True)
class MapSelection:
    """Replaces metallic and roughness by constants where validation views are reproduced as well."""

    #: A constant may lower PSNR by this many dB.
    psnr_loss: float = 0.05
    #: Up to this share of texels may be detected as metal by chance.
    metal_share: float = 0.002

    def applies(self, scene: Scene, state: State) -> bool:
        """Always."""
        return scene.target is not None

    def run(self, scene: Scene, state: State) -> State:
        """The maps that are needed."""
        assert scene.target is not None
        level, weight = state.level, texel_weight(filter(len, state.level.photos), len(state.values))
        photos = level.validation if level.validated else level.photos

        def psnr(materials: Materials) -> float | None:
            return state.decibels(photos, materials)

        return replace(state, selected=self.selected(state.materials, weight, int(state.metal.sum()), psnr, scene.target.skip))

    def selected(self, materials: Materials, weight: Floats, metals: int, psnr: Psnr, decide: Decide) -> Materials:
        """`materials` with constants in place of the maps that are not needed.

        `weight` (n,) is that of the pixels that show each texel, `metals` the number of texels detected as metal.
        """
        dielectric = without_metal(materials)
        as_good, evidence = self._compare(psnr(materials), psnr(dielectric), "metallic 0")
        evidence = f"{metals} metallic texels; {evidence}"
        if decide("metallic_map", metals <= self.metal_share * len(materials) and as_good, evidence, "metallic 0", "metallic mapped"):
            materials = dielectric
        constant = with_constant_roughness(materials, weight)
        name = f"roughness {constant.roughness[0]:.2f}" if len(constant) else "constant roughness"
        as_good, evidence = self._compare(psnr(materials), psnr(constant), name)
        return constant if decide("roughness_map", as_good, evidence, name, "roughness mapped") else materials

    def _compare(self, mapped: float | None, constant: float | None, name: str) -> tuple[bool, str]:
        """Whether the constant called `name` reproduces the views as well as the map, and the evidence."""
        if mapped is None or constant is None:
            return False, "no photos to compare"
        evidence = f"PSNR {constant:.2f} dB with {name}, {mapped:.2f} dB with a map; tolerance {self.psnr_loss:g} dB"
        return constant > mapped - self.psnr_loss, evidence


def without_metal(materials: Materials) -> Materials:
    """`materials` with metallic 0 and the same diffuse reflectance."""
    base = materials.base_color * (1 - materials.metallic[:, None])
    return replace(materials, base_color=base, metallic=np.zeros_like(materials.metallic))


def with_constant_roughness(materials: Materials, weight: Floats) -> Materials:
    """`materials` with the median roughness, weighted by `weight` (n,), in all texels."""
    roughness = materials.roughness
    order = np.argsort(roughness, kind="stable")
    total = np.cumsum(np.asarray(weight, np.float64)[order])
    if not len(total):
        return materials
    return replace(materials, roughness=np.full_like(roughness, roughness[order[np.searchsorted(total, 0.5 * total[-1])]]))
