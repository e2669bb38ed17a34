"""What a pass of the material fit is, and what it reads beside the state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gsbake.config.schema import Bake
from gsbake.geometry.cameras import Camera
from gsbake.materials.concurrent_fits import Each
from gsbake.materials.state import State
from gsbake.shading.light_motion import Motion
from gsbake.texturing.resampling import CoarseTexture
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

#: Called after every step with what is being done, the number of steps done and their total.
Progress = Callable[[str, int, int], None]
#: Decides on a rule of `[skip]`: its name, whether the measurement allows to skip, the evidence, and the choices if skipped and if not.
Decide = Callable[[str, bool, str, str, str], bool]


@dataclass(frozen=True)
class Priors:
    """Weights of the regularisation terms in `gsbake.materials.descent`; the settings of the same names in [bake]."""

    smoothness: float
    base_color_l1: float
    metallic_l1: float
    neutral_light: float
    sparsity: float

    @classmethod
    def of(cls, settings: Bake) -> Priors:
        """The weights in the settings of the bake."""
        return cls(settings.smoothness, settings.base_color_l1, settings.metallic_l1, settings.neutral_light, settings.sparsity)


def _silent(name: str, done: int, total: int) -> None:
    """Progress that nobody looks at."""


def _undecided(what: str, choice: str, evidence: str) -> None:
    """A decision that nobody looks at."""


@dataclass(frozen=True)
class Target:
    """Where the maps go: the `mesh` with the texels of the asset, which `texture` reduces to those of the fit, the photos' colours
    `projected` (n, 3) there, and their `cameras`; `skip` decides on a rule of [skip] by measurements."""

    mesh: UnwrappedMesh
    texture: CoarseTexture
    projected: NDArray[np.float32]
    cameras: Sequence[Camera]
    skip: Decide


@dataclass(frozen=True)
class Scene:
    """What passes read beside the state.

    `iterations` of one candidate in all; `light_size`, edge of the environment map's faces in texels; `diffuse`: without specular
    reflection; `without`, names of passes that are left out; `random` decides which texels searches look at. `motions`, the ways in
    which the light may move with its rotations (photos, 3, 3); whether a `flash` fired in all photos; `decide` reports a decision: what,
    the choice, the evidence. The maps go to the `target`.
    """

    priors: Priors
    iterations: int
    light_size: int
    seed: int = 0
    diffuse: bool = False
    without: frozenset[str] = frozenset()
    progress: Progress = _silent
    motions: Mapping[Motion, NDArray[np.float64] | None] = field(default_factory=dict)
    flash: bool = False
    decide: Callable[[str, str, str], None] = _undecided
    target: Target | None = None
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def steps(self, share: float) -> int:
        """Steps of a share of the iterations; at least one."""
        return max(1, round(share * self.iterations))

    def each(self, name: str) -> Each:
        """What reports the steps of `name`."""
        return lambda done, total: self.progress(name, done, total)


class Rule(ABC):
    """What a pass does; its options are the fields of its class."""

    def applies(self, scene: Scene, state: State) -> bool:
        """Whether the photos and the state so far call for it: always, unless a rule says otherwise."""
        return True

    @abstractmethod
    def run(self, scene: Scene, state: State) -> State:
        """The next state."""


@dataclass(frozen=True)
class Pass:
    """A `rule` by its name in the recipe. Among gradient steps it runs `at` these shares of them. Where it is left out, another rule takes
    its place if there is one `instead`."""

    name: str
    rule: Rule
    at: tuple[float, ...] = ()
    instead: Rule | None = None


def run_passes(passes: Iterable[Pass], scene: Scene, state: State) -> State:
    """The state after all `passes` in order that apply and are not left out."""
    for one in passes:
        rule = one.instead if one.name in scene.without else one.rule
        if rule is not None and rule.applies(scene, state):
            state = rule.run(scene, state)
    return state
