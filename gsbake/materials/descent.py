"""Gradient steps of the material fit: base colour, roughness and metallic of every texel and the environment map, against the photos.

Inverse rendering in texture space: with mesh, atlas and cameras fixed, each step shades the pixels of one photo (split sum, METHOD §6) and
takes an Adam step (Kingma & Ba 2015) on texels, normal offsets and light. The loss is

    Σ w ρ(sRGB(shade) − photo) + smoothness · |∇ texture| + base_color_l1 · mean (1 − metallic) base colour + metallic_l1 · mean metallic
    + neutral_light · colourfulness of the light + sparsity · residual · |texture − common materials|²

ρ is pseudo-Huber, so that a misplaced reflection has little influence; a plain L1 error ignores reflections that are slightly off and makes
the light too dim. The other terms are priors for what photos under one light leave open: neighbouring texels are similar; the L1 norm of
base colour resolves the albedo–illumination ambiguity; most surfaces are dielectric; most light is neutral; an object has few materials
(`sparsity_prior`, scaled by the residual: where photos are explained, they decide). Normal offsets let reflections refine the mesh's
normals. What gradients do not reach is searched for at shares of the steps; the steps that follow may revise what was found.

Adam divides each gradient by its own root mean square, so a texel of the light that hardly shows in any photo moves as far each step as
one that decides, in a direction that the noise of single photos gives. Only a learning rate that ends low leaves no speckles.

Munkberg et al., *Extracting triangular 3D models, materials, and lighting from images*, CVPR 2022, fit textures and a split-sum light
together in this way; visibility per texel and weights per view are added by the fixed mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.materials.adam_kernel import adam_step
from gsbake.materials.concurrent_fits import Each
from gsbake.materials.linear_shading import KernelTables, ShadingStep
from gsbake.materials.passes import Pass, Priors, Scene, run_passes
from gsbake.materials.photo import Photo
from gsbake.materials.sparsity_prior import KERNEL_WIDTHS, common_materials
from gsbake.materials.state import Level, State, copied
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_motion import rotated
from gsbake.shading.light_tables import LightTables, prefilter_cube_map
from gsbake.shading.neutral_light import neutral_light_loss

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Steps:
    """A run of gradient steps: a `share` of the iterations, with `rate` as a factor on all learning rates and the `passes` made on the way.

    Without `normals` normal offsets stay, without `sparsity` that prior is off. A light that stands takes a step for
    `photos_per_light` photos together.
    """

    share: float
    rate: float = 1.0
    normals: bool = False
    sparsity: bool = True
    passes: tuple[Pass, ...] = ()
    photos_per_light: int = 1


@dataclass(frozen=True)
class DescentOptions:
    """Constants of gradient steps. Rates are per step, points in time shares of all steps."""

    #: Adam's learning rates: of the texels' logits; of the environment map's raw values; of normal offsets, as the mesh's are nearly right.
    texel_rate: float = 0.15
    light_rate: float = 0.3
    normal_rate: float = 0.01
    #: Factors on the learning rates of texels and of the light at the last step; the decay is exponential.
    final_rate: float = 0.1
    light_final_rate: float = 0.03
    #: Adam's decay rates of the first and second moments; short, as a fit has a few hundred steps.
    betas: tuple[float, float] = (0.9, 0.99)
    #: Adam's ε for texels and normals, a gradient of the loss per texel: texels that few pixels show take smaller steps; and for the light.
    epsilon: float = 2e-3
    light_epsilon: float = 1e-8
    #: Factor on the reconstruction error against the priors.
    residual_weight: float = 1.5
    #: Pseudo-Huber scale in sRGB values (0..1): larger errors count linearly.
    robust_scale: float = 0.1
    #: Factors on the smoothness weight for base colour (3), roughness and metallic: prints change the base colour alone.
    smoothness_channels: tuple[float, ...] = (1.0, 1.0, 1.0, 6.0, 4.0)
    #: Weight of the squared normal offset: normals stay near those of the mesh.
    normal_offset_weight: float = 0.1
    #: Weight of the squared difference of neighbouring normal offsets, on a texture of 512 texels; grows with the square of the size, as
    #: the change per texel grows with their size.
    normal_smoothness: float = 60.0
    #: Steps between updates of visibility and indirect light, and of the common materials; all change slowly.
    transport_interval: int = 40
    sparsity_interval: int = 50
    #: Start of the sparsity prior: the light's intensity must be known.
    sparsity_from: float = 0.5
    #: Factor on the accumulated residual at each update of visibility: a running mean over about three updates.
    residual_decay: float = 0.7


OPTIONS = DescentOptions()


def descend(scene: Scene, state: State, plan: Steps, each: Each, steps: int | None = None) -> State:
    """The state after the gradient steps of `plan` and the passes among them; `steps`, where given, is their
    number. The order of photos follows from the scene's seed. `each(done, total)` is called after every step."""
    total = scene.steps(plan.share) if steps is None else steps
    photos = [photo for photo in state.level.photos if len(photo)]
    if not photos or not total:
        return state
    scene = replace(scene, random=np.random.default_rng(scene.seed))
    work = _Work(state, scene.priors, plan.photos_per_light)
    order: list[int] = []
    for step in range(total):
        due = [one for one in plan.passes if step in {int(share * total) for share in one.at}]
        found = run_passes(due, scene, work.state)
        searched = found is not work.state
        work.resume(found)
        if step % OPTIONS.transport_interval == 0:
            work.update_transport()
        sparse = plan.sparsity and scene.priors.sparsity and step >= OPTIONS.sparsity_from * total
        if sparse and (searched or step % OPTIONS.sparsity_interval == 0):
            work.update_common()
        order = order or scene.random.permutation(len(photos)).tolist()
        o = OPTIONS
        decay, light_decay = (plan.rate * final ** (step / total) for final in (o.final_rate, o.light_final_rate))
        work.step(photos[order.pop()], decay, light_decay, plan.normals)
        each(step + 1, total)
    return work.state


class _Lit:
    """A copy of a `light`, and the gradients of `photos` photos."""

    def __init__(self, light: EnvironmentLight) -> None:
        self.light, self.photos = copied(light), 0
        self._radiance, self._loss = self.light.radiance(), torch.zeros(())
        self._still: LightTables | None = None

    def tables(self, to_light: NDArray[np.float64] | None) -> LightTables:
        """The tables that a photo sees under the rotation `to_light` (3, 3), differentiable; None: the light stands."""
        if to_light is not None:
            return prefilter_cube_map(rotated(self._radiance, to_light))
        self._still = self._still or prefilter_cube_map(self._radiance)
        return self._still

    def add(self, tables: LightTables, gradient: Floats) -> None:
        """Add a photo's `gradient` (rows, 3) of its tables."""
        self._loss, self.photos = self._loss + (tables.table * torch.from_numpy(gradient)).sum(), self.photos + 1

    def gradient(self, neutral: float) -> torch.Tensor:
        """The gradient of the light's parameter, with the prior of `neutral` light for each photo."""
        loss = self._loss + self.photos * neutral * neutral_light_loss(self._radiance) if neutral else self._loss
        return torch.autograd.grad(loss, self.light.raw)[0]


class _Work:
    """Arrays that change from step to step, and the `state` that they make up."""

    def __init__(self, state: State, priors: Priors, interval: int) -> None:
        self._lit: _Lit | None = None
        self._interval = 1 if state.level.moving else interval
        self._priors, n = priors, len(state.values)
        self._shade, self._spare = ShadingStep(n), np.empty_like(state.values)
        self._common = np.zeros((0, 4), np.float32)
        self._residual = np.zeros(2)  # sums of weighted squared errors and of weights
        self._given = state.lights if state.light_given else None
        moments = (state.moments[0].copy(), state.moments[1].copy())
        self.state = replace(state, values=state.values.copy(), logits=state.logits.copy(), moments=moments)
        self._weights = _weights(state.level, priors)

    def resume(self, state: State) -> None:
        """Go on from a `state` that a search has made of the present one."""
        if state.light is not self.state.light:
            self._lit = None
        self.state = state

    def update_transport(self) -> None:
        """Visibility, indirect light and reflections of the present state; the residual of older ones counts less."""
        self.state = self.state.with_transport()
        self._residual *= OPTIONS.residual_decay

    def update_common(self) -> None:
        """The common materials that the sparsity prior draws to; emissive texels, whose base colour hardly shows, keep their own."""
        self._common = common_materials(self.state.materials, self.state.emits_nothing)

    def step(self, photo: Photo, decay: float, light_decay: float, normals: bool) -> None:
        """One step on the pixels of one photo, with learning rates times the decays; of the texels alone under a given light."""
        if self._given is not None:
            self._differentiate(photo, self._given.tables(photo.to_light))
        else:
            self._lit = self._lit or _Lit(self.state.light)
            tables = self._lit.tables(photo.to_light)
            self._differentiate(photo, KernelTables.of(tables))
            self._lit.add(tables, self._shade.table.sum(0))
            if self._lit.photos == self._interval:
                self._step_light(self._lit, light_decay)
        self._step_texels(decay, normals)

    def _step_light(self, lit: _Lit, decay: float) -> None:
        """One step of Adam on the light, from the gradients of the photos since the last one. PyTorch's own takes a second to import."""
        o, (beta1, beta2) = OPTIONS, OPTIONS.betas
        gradient = lit.gradient(len(self.state.values) * self._priors.neutral_light)
        zero = torch.zeros_like(gradient)
        first, second, count = self.state.light_moments or (zero, zero, 0)
        first, second, count = first.lerp(gradient, 1 - beta1), second.lerp(gradient.square(), 1 - beta2), count + 1
        with torch.no_grad():
            root = (second / (1 - beta2**count)).sqrt_().add_(o.light_epsilon)
            lit.light.raw.addcdiv_(first, root, value=-o.light_rate * decay / (1 - beta1**count))
        self.state, self._lit = replace(self.state, light=lit.light, light_moments=(first, second, count)), None

    def _differentiate(self, photo: Photo, tables: KernelTables) -> None:
        """Shade the pixels of a photo, leave the gradients in the buffers and add to the sums of the residual."""
        factor, o = len(self.state.values) / len(photo), OPTIONS
        sums = self._shade(photo, self.state.values, tables, self.state.transport, o.residual_weight, o.robust_scale, factor)
        self._residual += sums[1:]

    def _step_texels(self, decay: float, normals: bool) -> None:
        """One step on all texels, from the gradient of the photo, which is set to zero, and those of the priors."""
        o, f, state = OPTIONS, np.float32, self.state
        count = state.steps + 1
        residual = float(self._residual[0] / max(self._residual[1], 1e-6) / o.robust_scale**2)
        common_weight = np.zeros(4, f)
        if len(self._common):
            common_weight = (self._priors.sparsity * residual / np.square(KERNEL_WIDTHS)).astype(f)
        rate = np.array([o.texel_rate] * 5 + [o.normal_rate if normals else 0.0] * 3, f) * f(decay)
        beta1, beta2 = o.betas
        adam_step(
            state.logits, state.values, self._spare, self._shade.gradient, *state.moments, *state.level.surface.neighbour_lists,
            *self._weights, f(o.normal_offset_weight), self._common, common_weight, rate, f(beta1), f(beta2),
            f(1 / (1 - beta1**count)), f(1 / (1 - beta2**count)), f(o.epsilon),
        )  # fmt: skip
        self.state, self._spare = replace(state, values=self._spare, steps=count), state.values


def _weights(level: Level, priors: Priors) -> tuple[Floats, Floats]:
    """Weights (PARAMETERS,) of differences of neighbouring texels, and of the mean values."""
    o, f, surface = OPTIONS, np.float32, level.surface
    per_pair = len(surface.texels) / max(1, len(surface.pairs))
    normals = o.normal_smoothness * (surface.texels.size / 512) ** 2
    smoothness = np.array([*(priors.smoothness * np.array(o.smoothness_channels)), *[normals] * 3], f) * f(per_pair)
    return smoothness, np.array([*[priors.base_color_l1 / 3] * 3, 0, priors.metallic_l1, 0, 0, 0], f)
