"""From the coarse level of a fit to the fine one, and from there to the texture of the asset."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsbake.materials.descent import Steps, descend
from gsbake.materials.passes import Scene
from gsbake.materials.state import LIMITS, State
from gsbake.texturing.resampling import DETAIL_OFFSET, MAX_DETAIL_RATIO


@dataclass(frozen=True)
class PureMetals:
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
class FineLevel:
    """Goes on to the finer level, with base colours that take their detail from the photos' colours there."""

    def applies(self, scene: Scene, state: State) -> bool:
        """Where there is one."""
        return scene.finer is not None

    def run(self, scene: Scene, state: State) -> State:
        """The state interpolated at the finer texels."""
        assert scene.finer is not None
        up, level = scene.finer.texture.up, scene.finer.level.under(state.light_motion.rotations)
        values = up(state.values)
        detail = (level.surface.base_color + DETAIL_OFFSET) / (up(state.level.surface.base_color) + DETAIL_OFFSET)
        values[:, :3] = np.clip(values[:, :3] * np.clip(detail, 1 / MAX_DETAIL_RATIO, MAX_DETAIL_RATIO), *LIMITS.base_color)
        values[:, 3:5] = np.clip(values[:, 3:5], LIMITS.least, 1 - LIMITS.least)
        emission = up(state.transport["emission"])
        return state.on(level, np.ascontiguousarray(values, np.float32), emission)


@dataclass(frozen=True)
class GradientSteps:
    """Gradient `steps` on the present level, reported by the `name`."""

    steps: Steps
    name: str

    def applies(self, scene: Scene, state: State) -> bool:
        """Always."""
        return True

    def run(self, scene: Scene, state: State) -> State:
        """The state after the steps."""
        return descend(scene, state, self.steps, scene.each(self.name))


@dataclass(frozen=True)
class FullTexture:
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
