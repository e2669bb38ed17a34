"""Materials and light fitted in texture space: base colour, roughness and metallic of every texel against the photos.

With the mesh, its atlas and the cameras fixed, each step shades the pixels of one photo (split sum, METHOD §6) with the texels' occlusion
and takes an Adam step on texels and light:

    Σ w |sRGB(shade) − photo| + tv · |∇ texture| + dark · mean base colour + metal · mean metallic + white · colourfulness of the light

The first term is robust (L1), so a misplaced reflection moves little. The others settle what photos under one light leave open:
neighbouring texels are alike; what a reflection explains is not paint (a small price on base colour, which also fixes the light's
brightness); most things are not metal; most light is white.

How rough the object is at the start decides which light is found: a surface taken for rough cannot show where the light comes from and its
reflections end as paint; one taken for smooth blurs the light instead. So short trials from a few values compete on photos they were not
fitted to, and the best goes on; from there every texel finds its own.

Normals bend a little where reflections ask for it: meshes are smoother than the light is sharp.

Munkberg et al., *Extracting triangular 3D models, materials, and lighting from images*, CVPR 2022, fit textures and a split-sum light
together in this way; occlusion per texel and the view-wise weights are what a fixed mesh adds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbake.light.colour import colourfulness, linear_to_srgb
from gsbake.light.environment import EnvironmentLight
from gsbake.light.shade import shade
from gsbake.light.tables import LightTables
from gsbake.texture.pixels import Pixels
from gsbake.texture.texels import Texels

Floats = NDArray[np.float32]

#: Roughness of all texels that trials start from, and their steps, pixels of a photo and every how many-th photo judges them.
TRIALS, TRIAL_STEPS, TRIAL_PIXELS, TRIAL_PHOTO = (0.2, 0.45, 0.8), 100, 15_000, 5
#: Metallic that every texel starts from.
METALLIC = 0.05
#: Adam's rates of the texels' logits, of the light and of the normals' bends; all decay to a tenth.
RATE, RATE_LIGHT, RATE_BEND = 0.15, 0.1, 0.01
#: Prices on the square of a normal's bend and of its change between neighbouring texels of a texture of 512.
FLAT, EVEN = 0.1, 60.0
#: Adam's memory, and the gradient (of the loss per texel) below which it takes smaller steps: texels that one photo hardly sees.
BETAS, STILL = (0.9, 0.99), 2e-3
#: Logits start within this range of base colour.
BASE_RANGE = (0.01, 0.95)
#: Share of the neighbouring pairs of texels that one step compares.
COMPARED = 0.25


@dataclass(frozen=True)
class Priors:
    """Weights of what is believed without evidence; see the module's formula."""

    smooth: float = 0.03
    dark: float = 0.02
    metal: float = 0.003
    white: float = 0.005


@dataclass(frozen=True)
class Fitted:
    """`values` (n, 5): linear base colour, roughness, metallic of each texel; `bend` (n, 3) to be added to its unit normal; `weight` (n,):
    what all photos together say about it (in pixels); the `light` in the mesh's frame; PSNR in dB over the pixels of held-out photos (None
    without any)."""

    values: Floats
    bend: Floats
    weight: Floats
    light: EnvironmentLight
    held_out: float | None


class MaterialFit:
    """Holds texels and light while they are fitted."""

    def __init__(
        self,
        texels: Texels,
        normal: NDArray[Any],
        occlusion: NDArray[Any],
        base: NDArray[Any],
        light_size: int,
        priors: Priors,
        roughness: float,
    ) -> None:
        """`normal` (n, 3) unit normals of the n texels in the mesh's frame, `occlusion` (n,) their open share, `base` (n, 3) linear colours
        and `roughness` to start from; `light_size` is the edge of the environment cube map."""
        n = len(texels)
        logits = torch.zeros(n, 5)
        logits[:, :3] = torch.logit(torch.as_tensor(np.clip(base, *BASE_RANGE), dtype=torch.float32))
        logits[:, 3], logits[:, 4] = math.log(roughness / (1 - roughness)), math.log(METALLIC / (1 - METALLIC))
        self._logits = logits
        self._normal = torch.as_tensor(np.ascontiguousarray(normal, np.float32))
        self._bend = torch.zeros(n, 3, requires_grad=True)
        self._even = EVEN * (texels.size / 512) ** 2  # a slope per texel is steeper where texels are larger
        self._open = torch.as_tensor(np.ascontiguousarray(occlusion, np.float32))
        self._light = EnvironmentLight(light_size)
        self._priors = priors
        self._pairs = torch.as_tensor(_neighbours(texels))
        self._adam = torch.optim.Adam([self._logits.requires_grad_()], lr=RATE, betas=BETAS, eps=STILL)
        self._adam_bend = torch.optim.Adam([self._bend], lr=RATE_BEND, betas=BETAS, eps=STILL)
        self._adam_light = torch.optim.Adam([self._light.raw], lr=RATE_LIGHT, betas=BETAS)

    def run(
        self, photos: list[Pixels], held: list[Pixels], steps: int, seed: int, each: Callable[[int, int], None] | None = None
    ) -> Fitted:
        """Fit to `photos` in `steps` steps of one photo each, in an order drawn from `seed`; `held` only tell how good it got."""
        generator = torch.Generator().manual_seed(seed)
        batches = [_Batch.of(p, self._normal, self._open) for p in photos if len(p)]
        order: list[int] = []
        for step in range(steps if batches else 0):
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
        bend = self._bend.detach().numpy()
        score = self._score([_Batch.of(p, self._normal, self._open) for p in held if len(p)])
        return Fitted(values, bend, weight.numpy(), self._light, score)

    def _step(self, batch: _Batch, decay: float, generator: torch.Generator) -> None:
        values = torch.sigmoid(self._logits)
        shaded = batch.shade(values, self._bend, self._light.prefilter())
        error = (linear_to_srgb(shaded.clamp_min(0)) - batch.colour).abs().mean(1)
        priors = self._priors
        loss = (error * batch.weight).mean()
        loss = loss + priors.dark * values[:, :3].mean() + priors.metal * values[:, 4].mean()
        if priors.white:
            loss = loss + priors.white * colourfulness(self._light.radiance())
        if priors.smooth and len(self._pairs):
            count = max(1, int(COMPARED * len(self._pairs)))
            start = int(torch.randint(len(self._pairs) - count + 1, (1,), generator=generator))
            pair = self._pairs[start : start + count]
            loss = loss + priors.smooth * (values[pair[:, 0]] - values[pair[:, 1]]).abs().sum(1).mean()
            loss = loss + self._even * ((self._bend[pair[:, 0]] - self._bend[pair[:, 1]]) ** 2).sum(1).mean()
        loss = loss + FLAT * (self._bend**2).sum(1).mean()
        for adam, rate in ((self._adam, RATE), (self._adam_bend, RATE_BEND), (self._adam_light, RATE_LIGHT)):
            adam.zero_grad()
            adam.param_groups[0]["lr"] = rate * decay
        (loss * len(values)).backward()
        self._adam.step()
        self._adam_bend.step()
        self._adam_light.step()

    @torch.no_grad()
    def _score(self, batches: list[_Batch]) -> float | None:
        """PSNR in dB over all pixels of the batches."""
        if not batches:
            return None
        values, tables = torch.sigmoid(self._logits), self._light.prefilter()
        squares = torch.cat([((linear_to_srgb(b.shade(values, self._bend, tables).clamp_min(0)) - b.colour) ** 2).mean(1) for b in batches])
        return -10 * math.log10(max(float(squares.mean()), 1e-10))


def trial_roughness(
    make: Callable[[float], MaterialFit], photos: list[Pixels], seed: int, each: Callable[[int, int], None] | None = None
) -> dict[float, float]:
    """PSNR in dB on photos set aside, for each roughness in `TRIALS` as the start of a short fit.

    `make` builds a fit that starts from a roughness. Empty with fewer than `TRIAL_PHOTO` photos.
    """
    if len(photos) < TRIAL_PHOTO:
        return {}
    few = [p.thinned(TRIAL_PIXELS) for p in photos]
    judges, rest = few[::TRIAL_PHOTO], [p for i, p in enumerate(few) if i % TRIAL_PHOTO]
    found: dict[float, float] = {}
    for turn, roughness in enumerate(TRIALS):
        score = make(roughness).run(rest, judges, TRIAL_STEPS, seed).held_out
        if score is not None:
            found[roughness] = score
        if each is not None:
            each(turn + 1, len(TRIALS))
    return found


@dataclass(frozen=True)
class _Batch:
    """One photo's pixels as tensors, with what does not change: their normals and occlusion."""

    texel: Tensor
    share: Tensor
    towards: Tensor
    colour: Tensor
    weight: Tensor
    normal: Tensor
    open: Tensor

    @classmethod
    def of(cls, pixels: Pixels, normal: Tensor, occlusion: Tensor) -> _Batch:
        texel, share = torch.as_tensor(pixels.texel), torch.as_tensor(pixels.share)
        towards, colour, weight = (torch.as_tensor(x) for x in (pixels.towards, pixels.colour, pixels.weight))
        return cls(texel, share, towards, colour, weight, _read(normal, texel, share), _read(occlusion[:, None], texel, share)[:, 0])

    def shade(self, values: Tensor, bend: Tensor, tables: LightTables) -> Tensor:
        """Linear colours (n, 3) of the pixels when the texels have `values` (texels, 5)."""
        g = _read(values, self.texel, self.share)
        turned = self.normal + _read(bend, self.texel, self.share)
        return shade(turned, self.towards, g[:, :3], g[:, 3], g[:, 4], tables, self.open)


def _read(values: Tensor, texel: Tensor, share: Tensor) -> Tensor:
    """`values` (texels, c) read bilinearly at the four texels and shares (n, 4) of each pixel: (n, c)."""
    first, *others = (values[texel[:, k]] * share[:, k, None] for k in range(4))
    return sum(others, first)


def _neighbours(texels: Texels) -> NDArray[np.int64]:
    """Pairs (m, 2) of texels side by side in the texture, in a fixed mixed order."""
    size = texels.size
    slot = np.full((size, size), -1, np.int64)
    slot.ravel()[texels.index] = np.arange(len(texels))
    pairs = []
    for a, b in ((slot[:, :-1], slot[:, 1:]), (slot[:-1], slot[1:])):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]], 1))
    out = np.concatenate(pairs)
    blocks = np.array_split(out, max(1, len(out) // 256))
    np.random.default_rng(0).shuffle(blocks)
    return np.concatenate(blocks) if blocks else out
