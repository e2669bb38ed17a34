"""Materials and light fitted in texture space: base colour, roughness and metallic of every texel against the photos.

With the mesh, its atlas and the cameras fixed, each step shades the pixels of one photo (split sum, METHOD §6) with the texels' occlusion
and takes an Adam step on texels and light:

    Σ w ρ(sRGB(shade) − photo) + tv · |∇ texture| + dark · mean base colour + metal · mean metallic + white · colourfulness of the light
    + parsimony · unexplained · |texture − what is common|²

The first term is robust (pseudo-Huber: squares of small errors, large ones by themselves), so a misplaced reflection moves little; with
plain |error| reflections a little off are passed over and the light ends too dim. The others settle what photos under one light leave open:
neighbouring texels are alike; what a reflection explains is not paint (a small price on base colour, which also fixes the light's
brightness); most things are not metal; most light is white; an object is made of few materials (`parsimony`), which is believed as much as
the photos are left unexplained.

How rough the object is at the start decides which light is found (`starts`); from there every texel finds its own.

How bright and how even the light is hardly shows in gradients, as paint makes up for either: a few times it is searched for (`level`).

Metals are looked for when the light is known well enough, and again when they have sharpened it (`metal`); those found are set, and the
steps that follow may take it back.

Regions that glow by themselves are looked for once, before the last metals (`emission`); their light is then part of what they show, and
their paint starts again from black.

Normals bend a little where reflections ask for it: meshes are smoother than the light is sharp.

What the object keeps of the light from itself follows the present light (`visibility`), renewed every few steps without gradient: a shadow
is neither paint nor evenly grey. Light that comes from other texels is added to the diffuse part and so does not end as paint either.

Munkberg et al., *Extracting triangular 3D models, materials, and lighting from images*, CVPR 2022, fit textures and a split-sum light
together in this way; occlusion per texel and the view-wise weights are what a fixed mesh adds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbake.imaging.metrics import decibels
from gsbake.imaging.srgb_torch import linear_to_srgb
from gsbake.materials.bilateral import Alike
from gsbake.materials.emission import find_glow
from gsbake.materials.light_intensity import Level, find_level, graded
from gsbake.materials.metallic import Evidence, find_metals
from gsbake.materials.pixel_shading import AROUND, BOUNCED, GLOW, SENT, Batch
from gsbake.materials.pixels import Pixels
from gsbake.materials.sparsity_prior import NEAR, common
from gsbake.materials.visibility import Visibility
from gsbake.shading.cubemap import solid_angles
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.neutral_light import neutral_light_loss
from gsbake.texturing.texels import Texels

Floats = NDArray[np.float32]

#: Metallic that every texel starts from.
METALLIC = 0.05
#: Adam's rates of the texels' logits, of the light and of the normals' bends; all decay to a tenth.
RATE, RATE_LIGHT, RATE_BEND = 0.15, 0.15, 0.01
#: Prices on the square of a normal's bend and of its change between neighbouring texels of a texture of 512.
FLAT, EVEN = 0.1, 60.0
#: Adam's memory, and the gradient (of the loss per texel) below which it takes smaller steps: texels that one photo hardly sees.
BETAS, STILL = (0.9, 0.99), 2e-3
#: Logits start within this range of base colour.
BASE_RANGE = (0.01, 0.95)
#: Darkest base colour that paint goes on from when the light's level has changed.
DARK_PAINT = 1e-3
#: Shares of the steps after which metals are looked for, and the metallic that those found go on from; those that end below `STAYED`
#: were taken back.
METALS_AT, METAL, STAYED = (0.3, 0.55, 0.8), 0.8, 0.3
#: Shares of the steps after which the light's level is searched for, with this many pixels of texels whose metallic is below this; on matt
#: things the light's tint only in the first ones: their paint hardly tells it, and it drifts.
LEVEL_AT, LEVEL_PIXELS, PAINT, TINTED_MATT = (0.5, 0.6, 0.7, 0.8), 100_000, 0.3, 2
#: Share of the steps after which glowing regions are looked for: the light must be known.
GLOW_AT = 0.5
#: How much of the smoothness price base colour (three channels), roughness and metallic pay: print changes the colour alone.
ALIKE = (1.0, 1.0, 1.0, 6.0, 4.0)
#: Shadows and bounced light are renewed every so many steps.
RENEWED = 25
#: Share of the steps from which texels are drawn to common materials (the light's level must be known), looked up anew every so many steps.
COMMON_AT, COMMON_ANEW = 0.5, 50
#: How much of what was unexplained counts on when shadows are renewed.
KEPT = 0.7
#: Errors of sRGB values count by their square up to about the first, beyond by themselves; times the second.
ROBUST, STEEP = 0.1, 1.5
#: Share of the neighbouring pairs of texels that one step compares.
COMPARED = 0.25


@dataclass(frozen=True)
class Priors:
    """Weights of what is believed without evidence; see the module's formula."""

    smooth: float = 0.03
    dark: float = 0.005
    metal: float = 0.003
    white: float = 0.0005
    parsimony: float = 0.03


@dataclass(frozen=True)
class Fitted:
    """`values` (n, 5): linear base colour, roughness, metallic of each texel; `bend` (n, 3) to be added to its unit normal; `weight` (n,):
    what all photos together say about it (in pixels); `glow` (n, 3): its own radiance; the `light` in the mesh's frame; PSNR in dB over the
    pixels of held-out photos (None without any); `metal` (n,) the texels last found to be metal that stayed it; regions that glow, and what
    the searches for the light's level found."""

    values: Floats
    bend: Floats
    weight: Floats
    glow: Floats
    light: EnvironmentLight
    held_out: float | None
    metal: NDArray[np.bool_]
    glowing: int
    levels: tuple[Level, ...]


@dataclass(frozen=True)
class FitSurface:
    """What the fit knows of the n texels of a texture.

    `position`, unit `normal` (n, 3) in the mesh's frame; `pairs` (m, 2) neighbouring texels, mixed as `gsbake.materials.adjacency` does;
    `occlusion` (n,) ambient occlusion, 1 = open; `base_color` (n, 3) the initial linear base colour. With `visibility` shadows follow the
    light, with `indirect` texels light each other as well.
    """

    texels: Texels
    position: NDArray[Any]
    pairs: NDArray[np.int64]
    normal: NDArray[Any]
    occlusion: NDArray[Any]
    base_color: NDArray[Any]
    visibility: Visibility | None = None
    indirect: bool = True


@dataclass(frozen=True)
class FitSchedule:
    """What a fit does in `iterations` steps of one photo each, whose order follows from `seed`.

    Without `metallic` no metals are searched for, nor on an object that is `diffuse`. Without `emission` nothing is emissive, without
    `intensity` the light's intensity is left to gradient steps, without `sparsity` materials may be as many as there are texels.
    """

    iterations: int
    seed: int = 0
    metallic: bool = True
    emission: bool = True
    intensity: bool = True
    sparsity: bool = True
    diffuse: bool = False


class MaterialFit:
    """Holds texels and light while they are fitted."""

    def __init__(self, surface: FitSurface, light_size: int, priors: Priors, roughness: float) -> None:
        """`light_size` is the edge of the environment map's faces in texels, `roughness` the initial value of all texels."""
        texels, at, pairs, normal = surface.texels, surface.position, surface.pairs, surface.normal
        occlusion, base = surface.occlusion, surface.base_color
        n = len(texels)
        logits = torch.zeros(n, 5)
        logits[:, :3] = torch.logit(torch.as_tensor(np.clip(base, *BASE_RANGE), dtype=torch.float32))
        logits[:, 3], logits[:, 4] = math.log(roughness / (1 - roughness)), math.log(METALLIC / (1 - METALLIC))
        self._logits = logits
        self._normal = torch.as_tensor(np.ascontiguousarray(normal, np.float32))
        self._bend = torch.zeros(n, 3, requires_grad=True)
        self._even = EVEN * (texels.size / 512) ** 2  # a slope per texel is steeper where texels are larger
        open_share = torch.as_tensor(np.ascontiguousarray(occlusion, np.float32))[:, None]
        self._around = torch.cat([open_share, open_share, torch.zeros(n, AROUND - 2)], 1)
        self._texels, self._at, self._shown = texels, np.asarray(at, np.float64), base
        self._visibility, self._bounce = surface.visibility, surface.indirect
        self._light = EnvironmentLight(light_size)
        self._priors = priors
        self._common: torch.Tensor | None = None
        self._unexplained = torch.zeros(2)  # sums of squared errors with the pixels' weights, and of these
        self._alike, self._near = torch.tensor(ALIKE), torch.tensor(NEAR)
        self._pairs = torch.as_tensor(pairs)
        self._adam = torch.optim.Adam([self._logits.requires_grad_()], lr=RATE, betas=BETAS, eps=STILL)
        self._adam_bend = torch.optim.Adam([self._bend], lr=RATE_BEND, betas=BETAS, eps=STILL)
        self._adam_light = torch.optim.Adam([self._light.raw], lr=RATE_LIGHT, betas=BETAS)

    def run(
        self,
        photos: list[Pixels],
        held: list[Pixels],
        schedule: FitSchedule,
        each: Callable[[int, int], None] | None = None,
    ) -> Fitted:
        """Fit to `photos`; the pixels `held` are only used to measure the result. `each(done, total)` is called after every step."""
        steps, generator = schedule.iterations, torch.Generator().manual_seed(schedule.seed)
        batches = [Batch.of(p, self._normal) for p in photos if len(p)]
        order: list[int] = []
        metal, glowing = np.zeros(len(self._logits), bool), 0
        levels: list[Level] = []
        self._common, self._unexplained = None, torch.zeros(2)
        for step in range(steps if batches else 0):
            anew = step % COMMON_ANEW == 0
            if schedule.emission and step == int(GLOW_AT * steps):
                glowing = self._set_glow(batches)
            if schedule.intensity and step in {int(share * steps) for share in LEVEL_AT}:
                levels.append(self._set_level(batches, generator, not schedule.diffuse or len(levels) < TINTED_MATT, not levels))
                anew = True
            if schedule.metallic and not schedule.diffuse and step in {int(share * steps) for share in METALS_AT}:
                metal = self._set_metals(batches)
                anew = True
            if step % RENEWED == 0:
                self._renew()
                self._unexplained *= KEPT
            if schedule.sparsity and self._priors.parsimony and anew and step >= COMMON_AT * steps:
                self._common = self._find_common()
            order = order or torch.randperm(len(batches), generator=generator).tolist()
            self._step(batches[order.pop()], 0.1 ** (step / steps), generator)
            if each is not None:
                each(step + 1, steps)
        weight = torch.zeros(len(self._logits))
        for batch in batches:
            for k in range(4):
                weight.index_add_(0, batch.texel[:, k], batch.share[:, k] * batch.weight)
        with torch.no_grad():
            values = torch.sigmoid(self._logits).numpy()
        bend, own = self._bend.detach().numpy(), self._around[:, GLOW].numpy()
        metal &= values[:, 4] > STAYED
        return Fitted(values, bend, weight.numpy(), own, self._light, self.psnr(held), metal, glowing, tuple(levels))

    def _step(self, batch: Batch, decay: float, generator: torch.Generator) -> None:
        values = torch.sigmoid(self._logits)
        shaded = batch.shade(values, self._bend, self._light.prefilter(), self._around)
        # Clamped, a reflection brighter than white has no gradient: where the photo shows none, it is misplaced rather than too bright.
        error = linear_to_srgb(shaded.clamp(0, 1)) - batch.colour
        squares = error.square()
        self._unexplained += torch.stack([(squares.detach().mean(1) * batch.weight).sum(), batch.weight.sum()])
        error = STEEP * ((squares + ROBUST**2).sqrt() - ROBUST).mean(1)
        priors = self._priors
        loss = (error * batch.weight).mean()
        loss = loss + priors.dark * values[:, :3].mean() + priors.metal * values[:, 4].mean()
        if priors.white:
            loss = loss + priors.white * neutral_light_loss(self._light.radiance())
        if priors.smooth and len(self._pairs):
            count = max(1, int(COMPARED * len(self._pairs)))
            start = int(torch.randint(len(self._pairs) - count + 1, (1,), generator=generator))
            pair = self._pairs[start : start + count]
            loss = loss + priors.smooth * ((values[pair[:, 0]] - values[pair[:, 1]]).abs() @ self._alike).mean()
            loss = loss + self._even * ((self._bend[pair[:, 0]] - self._bend[pair[:, 1]]) ** 2).sum(1).mean()
        if self._common is not None:
            doubt = self._unexplained[0] / self._unexplained[1].clamp_min(1e-6) / ROBUST**2
            away = (torch.cat([linear_to_srgb(values[:, :3]), values[:, 3:4]], 1) - self._common) / self._near
            loss = loss + priors.parsimony * doubt * 0.5 * away.square().sum(1).mean()
        loss = loss + FLAT * (self._bend**2).sum(1).mean()
        for adam, rate in ((self._adam, RATE), (self._adam_bend, RATE_BEND), (self._adam_light, RATE_LIGHT)):
            adam.zero_grad()
            adam.param_groups[0]["lr"] = rate * decay
        (loss * len(values)).backward()
        self._adam.step()
        self._adam_bend.step()
        self._adam_light.step()

    @torch.no_grad()
    def _renew(self) -> None:
        """Let shadows and bounced light follow the present light and materials."""
        if self._visibility is None:
            return
        openness = torch.as_tensor(self._visibility.openness(self._light.radiance().numpy()))
        self._around[:, 0] = openness
        if self._bounce:
            values = torch.sigmoid(self._logits)
            # (1 − m) albedo + F0: whatever the roughness, what is not reflected as paint is reflected as gloss.
            reflectance = values[:, :3] + 0.04 * (1 - values[:, 4:])
            irradiance = self._light.prefilter().diffuse(self._normal) * openness[:, None]
            bounced = torch.as_tensor(self._visibility.bounced(irradiance.numpy(), reflectance.numpy()))
            self._around[:, BOUNCED] = bounced
            self._around[:, SENT] = reflectance * (irradiance + bounced) + self._around[:, GLOW]

    @torch.no_grad()
    def _find_common(self) -> torch.Tensor:
        """The material (n, 4) that each texel is drawn to: its own where it glows, whose paint hardly shows."""
        return torch.as_tensor(common(torch.sigmoid(self._logits).numpy(), self._dark().numpy()))

    def _dark(self) -> torch.Tensor:
        """Which texels (n,) have no light of their own."""
        return self._around[:, GLOW].sum(1) == 0

    @torch.no_grad()
    def _set_level(self, batches: list[Batch], generator: torch.Generator, tint: bool, rough: bool) -> Level:
        """Let the light go on as bright and as even as explains most, and paint as rough and as what reflects the same; what was found."""
        values = torch.sigmoid(self._logits)
        paint = (values[:, 4] < PAINT) & self._dark()
        share = min(1.0, LEVEL_PIXELS / max(1, sum(len(b.weight) for b in batches)))
        asked = paint & (torch.rand(len(paint), generator=generator) < share)
        few = [part for b in batches if len((part := b.showing(asked)).weight)]
        if not few:
            return Level(np.ones(3), 1.0, 0.0, 0.0)
        radiance, area = self._light.radiance().numpy(), solid_angles(self._light.size)

        def regraded(brightness: NDArray[np.float64], contrast: float) -> EnvironmentLight:
            return EnvironmentLight.from_radiance(graded(radiance, brightness, contrast, area))

        def under(brightness: NDArray[np.float64], contrast: float) -> list[Evidence]:
            light = regraded(brightness, contrast)
            around = self._around.clone()
            if self._visibility is not None:
                around[:, 0] = torch.as_tensor(self._visibility.openness(light.radiance().numpy()))
            tables = light.prefilter()
            return [b.evidence(self._bend, tables, around) for b in few]

        found = find_level(under, values[:, 3].numpy(), tint, rough)
        if found.gain <= 0:
            return found
        before = self._light.prefilter().diffuse(self._normal) * self._around[:, :1]
        self._light.raw.copy_(regraded(found.brightness, found.contrast).raw)
        self._adam_light.state.clear()
        self._renew()
        after = self._light.prefilter().diffuse(self._normal) * self._around[:, :1]
        at = torch.nonzero(paint)[:, 0]
        start = values[at].numpy()
        start[:, :3] = np.clip(start[:, :3] * (before[at] / after[at].clamp_min(1e-6)).numpy(), DARK_PAINT, BASE_RANGE[1])
        start[:, 3] = found.roughened(start[:, 3])
        self._restart(at.numpy(), start)
        return found

    @cached_property
    def _like(self) -> Alike:
        """Averages over texels that look alike; a trial never asks for them."""
        return Alike(self._texels, self._pairs.numpy(), self._shown)

    @torch.no_grad()
    def _set_metals(self, batches: list[Batch]) -> NDArray[np.bool_]:
        """Start texels that metal explains better anew, as that metal; which (n,) they are."""
        tables = self._light.prefilter()
        own = torch.sigmoid(self._logits[:, 3]).numpy()
        found = find_metals([b.evidence(self._bend, tables, self._around) for b in batches], own, self._like)
        start = np.column_stack([np.clip(found.base, *BASE_RANGE), found.roughness, np.full(len(found.texel), METAL)])
        self._restart(found.texel, start)
        return np.isin(np.arange(len(own)), found.texel)

    @torch.no_grad()
    def _set_glow(self, batches: list[Batch]) -> int:
        """Give the regions that glow their light and start their paint anew from black; how many regions they are."""
        tables = self._light.prefilter()
        values = torch.sigmoid(self._logits).numpy()
        found = find_glow([b.evidence(self._bend, tables, self._around) for b in batches], values[:, 3], self._pairs.numpy(), self._at)
        self._around[torch.as_tensor(found.texel), GLOW] = torch.as_tensor(found.radiance, dtype=torch.float32)
        black = values[found.texel]
        black[:, :3], black[:, 4] = BASE_RANGE[0], METALLIC
        self._restart(found.texel, black)
        return found.regions

    def _restart(self, texel: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Let texels (m,) go on from `values` (m, 5), without the optimiser's memory of what they were."""
        at = torch.as_tensor(texel)
        self._logits[at] = torch.logit(torch.as_tensor(values, dtype=torch.float32))
        for moment in self._adam.state[self._logits].values():
            if moment.shape == self._logits.shape:
                moment[at] = 0

    @torch.no_grad()
    def showing(self, pixels: Pixels, asked: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Evidence]:
        """Which (m,) of the `pixels` show mostly texels that are `asked` (n,) for, and these as evidence under the light found."""
        batch, there = Batch.of(pixels, self._normal), torch.as_tensor(asked)
        rows = torch.nonzero(there[batch.foremost])[:, 0]
        return rows.numpy(), batch.showing(there).evidence(self._bend, self._light.prefilter(), self._around)

    @torch.no_grad()
    def psnr(self, photos: list[Pixels], values: Floats | None = None) -> float | None:
        """PSNR in dB over all pixels of `photos` (None without any) of the texels as they are, or with `values` (n, 5) instead."""
        batches = [Batch.of(p, self._normal) for p in photos if len(p)]
        if not batches:
            return None
        shown, tables = torch.sigmoid(self._logits) if values is None else torch.as_tensor(values), self._light.prefilter()
        shaded = (b.shade(shown, self._bend, tables, self._around).clamp_min(0) for b in batches)
        squares = torch.cat([((linear_to_srgb(s) - b.colour) ** 2).mean(1) for s, b in zip(shaded, batches, strict=True)])
        return decibels(float(squares.mean()))
