"""One photo against frozen surfels: the twist and the exposure gain that bring it and its render together.

Gauss–Newton on the picture (Lucas and Kanade, IJCAI 1981; Baker and Matthews, IJCV 2004): a small twist moves what is seen at a pixel by
the flow of its depth, so that the render changes by −∇I · flow. One render per iteration, no pass back through the rasteriser. Residuals
are weighted by Cauchy's function; the twist is held to few pixels by a prior, which decides where the photo says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.imaging.metrics import decibels
from gsbake.surfels.raster.gbuffer import rasterise, rendered_image
from gsbake.surfels.raster.rasterise import Rendered
from gsbake.surfels.training.corrections import OFFSET, POWER, Correction, then
from gsbake.surfels.training.views import TrainView

#: Blur (pixels) of render and photo in each iteration: from what finds the way to what is exact.
BLURS = (3.0, 1.5, 1.0)
#: Prior: root mean square motion (pixels) and log gain that are to be expected.
PRIOR_PIXELS, PRIOR_GAIN = 3.0, 0.3
#: Neighbouring residuals are alike: so many count as one.
ALIKE = 100.0
#: Residuals are no smaller than this (sRGB, 0..1).
LEAST_SPREAD = 0.01
#: Only pixels where the picture changes by this per pixel (sRGB, 0..1) are looked at, and at most and at least so many.
LEAST_SLOPE, MOST_PIXELS, LEAST_PIXELS = 0.004, 12_000, 100
#: A photo is never moved by more than this share of its longer side.
FARTHEST = 0.04


@dataclass(frozen=True)
class Scene:
    """What photos are aligned to. `draw` renders a view: its picture (3, h, w) over the background, and the render; `masked` says whether
    photos are cut out."""

    draw: Callable[[TrainView], tuple[Tensor, Rendered]]
    masked: bool
    background: Tensor

    def photo(self, view: TrainView) -> Tensor:
        """The photo (3, h, w) as the render is to look: over the background where masks cut it out."""
        colour, cover = view.colour(), view.cover()
        if not self.masked or cover is None:
            return colour
        return colour * cover + self.background[:, None, None] * (1 - cover)

    def inside(self, view: TrainView, alpha: Tensor) -> Tensor:
        """Pixels (h, w) that are compared: where mask or render shows the object, without masks where the render does."""
        cover = view.cover()
        shown = alpha > 0.5
        return shown if not self.masked or cover is None else shown | (cover > 0.5)


def blurred(planes: Tensor, sigma: float) -> Tensor:
    """Planes (c, h, w) under a Gaussian of `sigma` pixels, continued at the border."""
    reach = max(1, round(3 * sigma))
    x = torch.arange(-reach, reach + 1, dtype=planes.dtype, device=planes.device)
    g = torch.exp(-x * x / (2 * sigma * sigma))
    g = (g / g.sum()).expand(len(planes), 1, 1, -1)
    wide = F.pad(planes[None], (reach, reach, reach, reach), mode="replicate")
    return F.conv2d(F.conv2d(wide, g, groups=len(planes)), g.transpose(2, 3), groups=len(planes))[0]


def gradients(planes: Tensor) -> Tensor:
    """Central differences (2, c, h, w) along x and y of planes (c, h, w); the border's are zero."""
    out = torch.zeros(2, *planes.shape, dtype=planes.dtype, device=planes.device)
    out[0, :, :, 1:-1] = (planes[:, :, 2:] - planes[:, :, :-2]) / 2
    out[1, :, 1:-1] = (planes[:, 2:] - planes[:, :-2]) / 2
    return out


def flow(view: TrainView, depth: Tensor, index: Tensor) -> Tensor:
    """How a twist moves what is seen (k, 2, 6): pixels along x and y per ω and τ, at the flat pixels `index` (k,) with z-depth (k,)."""
    p = view.pinhole
    x = ((index % p.width).to(depth) + 0.5 - p.cx) / p.fx
    y = ((index // p.width).to(depth) + 0.5 - p.cy) / p.fy
    seen = torch.stack([x * depth, y * depth, depth], 1) - view.t  # from the object's centre, along the camera's axes
    a, b, c = seen.unbind(1)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    # columns of the point's motion: ω × seen, then τ
    motion = torch.stack(
        [torch.stack([zero, c, -b, one, zero, zero], 1), torch.stack([-c, zero, a, zero, one, zero], 1),
         torch.stack([b, -a, zero, zero, zero, one], 1)], 1,
    )  # fmt: skip
    u = p.fx * (motion[:, 0] - x[:, None] * motion[:, 2]) / depth[:, None]
    v = p.fy * (motion[:, 1] - y[:, None] * motion[:, 2]) / depth[:, None]
    return torch.stack([u, v], 1)


def spread_depth(depth: Tensor, alpha: Tensor, sigma: float) -> Tensor:
    """Expected z-depth (h, w), continued past the outline as far as a blur of `sigma` carries colours; 0 beyond."""
    known = (alpha > 0.5).to(depth)
    both = blurred(torch.stack([depth * known, known]), 2 * sigma)
    return torch.where(known > 0, depth, torch.where(both[1] > 1e-3, both[0] / both[1].clamp_min(1e-3), torch.zeros_like(depth)))


@torch.no_grad()
def align(
    scene: Scene, view: TrainView, start: Correction, poses: bool, gains: bool, used: Tensor | None = None, blurs: Sequence[float] = BLURS
) -> Correction:
    """The correction of the view that fits it to the scene, from `start` on: its twist with `poses`, its exposure with `gains`.

    `used` (h, w) are the pixels that may be looked at (all by default). Where nothing can be compared `start` is returned.
    """
    found = start
    for sigma in blurs:
        step = _step(scene, view, found, poses, gains, used, sigma)
        if step is None:
            return start
        found = step
    return found


def _step(scene: Scene, view: TrainView, now: Correction, poses: bool, gains: bool, used: Tensor | None, sigma: float) -> Correction | None:
    """One Gauss–Newton step from `now`, at one blur; None where nothing can be compared."""
    corrected = now.of(view)
    render, out = scene.draw(corrected)
    smooth, target = blurred(torch.cat([render, out.alpha[None]]), sigma), blurred(scene.photo(corrected), sigma)
    depth = spread_depth(out.expected_depth(), out.alpha, sigma)
    compared = (smooth[3] > 0.02) & (depth > 0) if scene.masked else (smooth[3] > 0.98) & (depth > 0)
    if used is not None:
        compared &= used
    slope = gradients(smooth[:3])
    index = (compared & (slope.abs().amax((0, 1)) > LEAST_SLOPE)).flatten().nonzero()[:, 0]
    if len(index) < LEAST_PIXELS:
        return None
    index = index[:: -(-len(index) // MOST_PIXELS)]
    move = flow(corrected, depth.flatten()[index], index)
    colour = smooth[:3].flatten(1)[:, index]
    columns = -torch.einsum("dck,kds->ksc", slope.flatten(2)[:, :, index], move)  # (k, 6, 3)
    residual = (target.flatten(1)[:, index] - colour).T  # (k, 3)
    jacobian = torch.cat([columns, torch.diag_embed(POWER * (colour.T + OFFSET))], 1)
    size = residual.abs().mean(1)
    spread = max(1.5 * float(size.median()), LEAST_SPREAD)
    weight = 1 / (1 + (size / (2 * spread)) ** 2)
    weighted = jacobian * weight[:, None, None] / (3 * ALIKE * spread * spread)
    normal = torch.einsum("kic,kjc->ij", weighted, jacobian).double().cpu()
    right = torch.einsum("kic,kc->i", weighted, residual).double().cpu()
    metric = torch.einsum("kdi,kdj->ij", move, move).double().cpu() / len(index)  # twist → squared pixels
    prior = torch.block_diag(metric / PRIOR_PIXELS**2, torch.eye(3, dtype=torch.float64) / PRIOR_GAIN**2)
    normal += prior
    right -= prior @ torch.cat([now.twist, now.gain])
    free = torch.tensor([poses] * 6 + [gains] * 3)
    solved = torch.zeros(9, dtype=torch.float64)
    solved[free] = torch.linalg.solve(normal[free][:, free], right[free])
    twist = then(now.twist, solved[:6])
    length = float((twist @ metric @ twist).clamp_min(0).sqrt())
    bound = FARTHEST * max(view.pinhole.width, view.pinhole.height)
    if length > bound:
        twist = twist * (bound / length)
    return Correction(twist, now.gain + solved[6:])


@torch.no_grad()
def motion(scene: Scene, view: TrainView, correction: Correction) -> float:
    """Root mean square motion in pixels of what the view shows of the object, under a correction; 0 where it shows nothing."""
    _, out = scene.draw(view)
    index = (out.alpha > 0.5).flatten().nonzero()[:, 0]
    moved = flow(view, out.expected_depth().flatten()[index], index) @ correction.twist.to(view.t)
    return float(moved.square().sum(1).mean().sqrt()) if len(index) else 0.0


@torch.no_grad()
def psnr(scene: Scene, view: TrainView, correction: Correction, used: Tensor) -> float:
    """PSNR (dB) of the corrected view's render against its photo, over the pixels `used` (h, w) that show the object as it was given."""
    inside = scene.inside(view, scene.draw(view)[1].alpha) & used
    corrected = correction.of(view)
    error = (scene.draw(corrected)[0] - scene.photo(corrected)).square().mean(0)[inside]
    return decibels(float(error.mean())) if len(error) else 0.0


def scene_of(surfels: object, light: object, masked: bool, background: Tensor) -> Scene:
    """The scene of surfels (`Surfels`) and light (`EnvironmentLight` or None) as they are now."""
    tables = None if light is None else light.prefilter()  # type: ignore[attr-defined]

    def draw(view: TrainView) -> tuple[Tensor, Rendered]:
        out = rasterise(surfels, view)  # type: ignore[arg-type]
        return rendered_image(out.planes, view, tables) + background[:, None, None] * (1 - out.alpha), out

    return Scene(draw, masked, background)
