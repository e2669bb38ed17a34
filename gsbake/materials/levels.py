"""From the coarse level of a fit to the fine one, and from there to the maps of the asset.

Metallic and roughness are replaced by constants where validation views are reproduced as well: photos of a diffuse object hardly determine
either, so per-texel values are mostly noise, which another environment makes visible.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsbake.materials.descent import Steps, descend
from gsbake.materials.passes import Decide, Rule, Scene
from gsbake.materials.photo import texel_weight
from gsbake.materials.state import LIMITS, State
from gsbake.materials.surface import Materials
from gsbake.texturing.resampling import DETAIL_OFFSET, MAX_DETAIL_RATIO

Floats = NDArray[np.float32]
#: PSNR in dB of validation views with some materials; None without views.
Psnr = Callable[[Materials], float | None]


@dataclass(frozen=True)
class PureMetals(Rule):
    """Scales metallic, where it is metal, so that its median there is 1: metals are pure.

    Gradient steps leave it lower, as a share of diffuse reflection makes up for reflections that are misplaced.
    """

    def applies(self, scene: Scene, state: State) -> bool:
        """Where most is metal."""
        return not state.mostly_dielectric

    def run(self, scene: Scene, state: State) -> State:
        """Metallic scaled."""
        texel = np.flatnonzero(state.metal)
        if not len(texel):
            return state
        m = state.materials.of(texel)
        return state.with_materials(texel, replace(m, metallic=np.minimum(m.metallic / np.median(m.metallic), LIMITS.pure_metal)))


@dataclass(frozen=True)
class FineLevel(Rule):
    """Goes on to the next finer level, with base colours that take their detail from the photos' colours there."""

    def applies(self, scene: Scene, state: State) -> bool:
        """Where there is one."""
        return state.level.finer is not None

    def run(self, scene: Scene, state: State) -> State:
        """The state interpolated at the finer texels."""
        assert state.level.finer is not None
        up, level = state.level.finer.texture.up, state.level.finer.level.under(state.light_motion.rotations)
        values = up(state.values)
        detail = (level.surface.base_color + DETAIL_OFFSET) / (up(state.level.surface.base_color) + DETAIL_OFFSET)
        values[:, :3] = np.clip(values[:, :3] * np.clip(detail, 1 / MAX_DETAIL_RATIO, MAX_DETAIL_RATIO), *LIMITS.base_color)
        values[:, 3:5] = np.clip(values[:, 3:5], LIMITS.least, 1 - LIMITS.least)
        emission = up(state.transport["emission"])
        return state.on(level, np.ascontiguousarray(values, np.float32), emission)


@dataclass(frozen=True)
class GradientSteps(Rule):
    """Gradient `steps` on the present level, reported by the `name`."""

    steps: Steps
    name: str

    def run(self, scene: Scene, state: State) -> State:
        """The state after the steps, with the light's intensity that searches left."""
        found = descend(scene, state, self.steps, scene.each(self.name))
        return replace(found, intensity=found.mean_intensity)


@dataclass(frozen=True)
class FullTexture(Rule):
    """Brings the maps to the texels of the asset, with the fine detail of the photos' colours."""

    def applies(self, scene: Scene, state: State) -> bool:
        """Where there are such texels."""
        return scene.target is not None

    def run(self, scene: Scene, state: State) -> State:
        """The maps at all texels of the asset."""
        assert scene.target is not None
        up, maps = scene.target.texture.up, state.selected or state.materials
        values = up(np.column_stack([maps.base_color, maps.roughness, maps.metallic]))
        detail = scene.target.texture.detail(scene.target.projected)
        emission = up(state.transport["emission"]) * detail if state.emissive_regions else None
        full = replace(maps, base_color=values[:, :3] * detail, roughness=values[:, 3], metallic=values[:, 4], emission=emission)
        return replace(state, maps=replace(full, normal_offset=up(state.values[:, 5:])))


@dataclass(frozen=True)
class MapSelection(Rule):
    """Replaces metallic and roughness by constants where validation views are reproduced as well."""

    #: A constant may lower PSNR by this many dB.
    psnr_loss: float = 0.05
    #: Up to this share of texels may be detected as metal by chance.
    metal_share: float = 0.002

    def applies(self, scene: Scene, state: State) -> bool:
        """Where maps are wanted."""
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
