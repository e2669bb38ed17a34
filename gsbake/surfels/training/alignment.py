"""Direct image alignment of one photo to frozen surfels: pose twist and exposure gain by Gauss–Newton.

Lucas and Kanade, IJCAI 1981; Baker and Matthews, IJCV 2004: a small twist moves the surface point at a pixel by the optical flow of its
depth, so the render changes by −∇I · flow. One render per iteration, no backward pass through the rasteriser. Residuals have Cauchy
weights; a prior limits the twist to few pixels where the photo does not determine it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbake.imaging.metrics import decibels
from gsbake.surfels.gbuffer import rasterise, rendered_image
from gsbake.surfels.raster.rasterise import Rendered
from gsbake.surfels.training.corrections import SRGB_EXPONENT, SRGB_OFFSET, Correction, CorrectionKinds, compose
from gsbake.surfels.views import TrainView

#: Gaussian blur (standard deviation in pixels) of render and photo in each iteration: from a wide basin of convergence to precision.
BLURS = (3.0, 1.5, 1.0)
#: Standard deviations of the prior: root mean square motion (pixels) and log gain.
PRIOR_PIXELS, PRIOR_GAIN = 3.0, 0.3
#: Number of correlated neighbouring residuals that count as one independent measurement.
CORRELATED_PIXELS = 100.0
#: Minimum scale of the residuals (sRGB, 0..1).
MIN_RESIDUAL_SCALE = 0.01
#: Minimum image gradient of the pixels used (sRGB 0..1 per pixel), and the largest and smallest number of them.
MIN_GRADIENT, MAX_PIXELS, MIN_PIXELS = 0.004, 12_000, 100
#: Largest root mean square motion as a share of the photo's longer side.
MAX_MOTION_SHARE = 0.04


@dataclass(frozen=True)
class Scene:
    """What photos are aligned to. `render` returns a view's image (3, h, w) over the background, and the G-buffer; `masked` says whether
    masks replace the photos' background."""

    render: Callable[[TrainView], tuple[Tensor, Rendered]]
    masked: bool
    background: Tensor

    def photo(self, view: TrainView) -> Tensor:
        """The photo (3, h, w), over the scene's background where there is a mask."""
        colour, cover = view.colour(), view.cover()
        if not self.masked or cover is None:
            return colour
        return colour * cover + self.background[:, None, None] * (1 - cover)

    def inside(self, view: TrainView, alpha: Tensor) -> Tensor:
        """Pixels (h, w) that are compared: where the mask or the render shows the object; without masks, where the render does."""
        cover = view.cover()
        shown = alpha > 0.5
        return shown if not self.masked or cover is None else shown | (cover > 0.5)


def gaussian_blur(planes: Tensor, sigma: float) -> Tensor:
    """Planes (c, h, w) blurred by a Gaussian of `sigma` pixels, with replicated borders."""
    reach = max(1, round(3 * sigma))
    x = torch.arange(-reach, reach + 1, dtype=planes.dtype, device=planes.device)
    g = torch.exp(-x * x / (2 * sigma * sigma))
    g = (g / g.sum()).expand(len(planes), 1, 1, -1)
    wide = F.pad(planes[None], (reach, reach, reach, reach), mode="replicate")
    return F.conv2d(F.conv2d(wide, g, groups=len(planes)), g.transpose(2, 3), groups=len(planes))[0]


def image_gradients(planes: Tensor) -> Tensor:
    """Central differences (2, c, h, w) along x and y of planes (c, h, w); zero at the border."""
    out = torch.zeros(2, *planes.shape, dtype=planes.dtype, device=planes.device)
    out[0, :, :, 1:-1] = (planes[:, :, 2:] - planes[:, :, :-2]) / 2
    out[1, :, 1:-1] = (planes[:, 2:] - planes[:, :-2]) / 2
    return out


def flow_jacobian(view: TrainView, depth: Tensor, index: Tensor) -> Tensor:
    """Jacobian (k, 2, 6) of optical flow in pixels along x and y by twist (ω, τ), at the flat pixels `index` (k,) with z-depth (k,)."""
    p = view.pinhole
    x = ((index % p.width).to(depth) + 0.5 - p.cx) / p.fx
    y = ((index // p.width).to(depth) + 0.5 - p.cy) / p.fy
    point = torch.stack([x * depth, y * depth, depth], 1) - view.t  # from the object's centre, along the camera's axes
    a, b, c = point.unbind(1)
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    # columns of the point's motion: ω × point, then τ
    point_motion = torch.stack(
        [torch.stack([zero, c, -b, one, zero, zero], 1), torch.stack([-c, zero, a, zero, one, zero], 1),
         torch.stack([b, -a, zero, zero, zero, one], 1)], 1,
    )  # fmt: skip
    u = p.fx * (point_motion[:, 0] - x[:, None] * point_motion[:, 2]) / depth[:, None]
    v = p.fy * (point_motion[:, 1] - y[:, None] * point_motion[:, 2]) / depth[:, None]
    return torch.stack([u, v], 1)


def extrapolate_depth(depth: Tensor, alpha: Tensor, sigma: float) -> Tensor:
    """Expected z-depth (h, w), extrapolated past the silhouette as far as a blur of `sigma` reaches; 0 beyond."""
    known = (alpha > 0.5).to(depth)
    both = gaussian_blur(torch.stack([depth * known, known]), 2 * sigma)
    return torch.where(known > 0, depth, torch.where(both[1] > 1e-3, both[0] / both[1].clamp_min(1e-3), torch.zeros_like(depth)))


@torch.no_grad()
def align(
    scene: Scene, view: TrainView, start: Correction, kinds: CorrectionKinds, mask: Tensor | None = None, blurs: Sequence[float] = BLURS
) -> Correction:
    """The correction of the given `kinds` that aligns the view to the scene, initialised with `start`.

    `mask` (h, w) are the pixels that may be used (all by default). `start` is returned where too few pixels can be compared.
    """
    found = start
    for sigma in blurs:
        step = _gauss_newton_step(scene, view, found, kinds, mask, sigma)
        if step is None:
            return start
        found = step
    return found


def _gauss_newton_step(
    scene: Scene, view: TrainView, current: Correction, kinds: CorrectionKinds, mask: Tensor | None, sigma: float
) -> Correction | None:
    """One Gauss–Newton step from `current`, at one blur; None where too few pixels can be compared."""
    corrected = current.apply(view)
    render, out = scene.render(corrected)
    smooth, target = gaussian_blur(torch.cat([render, out.alpha[None]]), sigma), gaussian_blur(scene.photo(corrected), sigma)
    depth = extrapolate_depth(out.expected_depth(), out.alpha, sigma)
    valid = (smooth[3] > 0.02) & (depth > 0) if scene.masked else (smooth[3] > 0.98) & (depth > 0)
    if mask is not None:
        valid &= mask
    gradient = image_gradients(smooth[:3])
    index = (valid & (gradient.abs().amax((0, 1)) > MIN_GRADIENT)).flatten().nonzero()[:, 0]
    if len(index) < MIN_PIXELS:
        return None
    index = index[:: -(-len(index) // MAX_PIXELS)]
    flow = flow_jacobian(corrected, depth.flatten()[index], index)
    colour = smooth[:3].flatten(1)[:, index]
    columns = -torch.einsum("dck,kds->ksc", gradient.flatten(2)[:, :, index], flow)  # (k, 6, 3)
    residual = (target.flatten(1)[:, index] - colour).T  # (k, 3)
    jacobian = torch.cat([columns, torch.diag_embed(SRGB_EXPONENT * (colour.T + SRGB_OFFSET))], 1)
    size = residual.abs().mean(1)
    spread = max(1.5 * float(size.median()), MIN_RESIDUAL_SCALE)
    weight = 1 / (1 + (size / (2 * spread)) ** 2)
    weighted = jacobian * weight[:, None, None] / (3 * CORRELATED_PIXELS * spread * spread)
    normal = torch.einsum("kic,kjc->ij", weighted, jacobian).double().cpu()
    right = torch.einsum("kic,kc->i", weighted, residual).double().cpu()
    metric = torch.einsum("kdi,kdj->ij", flow, flow).double().cpu() / len(index)  # twist → squared pixels
    prior = torch.block_diag(metric / PRIOR_PIXELS**2, torch.eye(3, dtype=torch.float64) / PRIOR_GAIN**2)
    normal += prior
    right -= prior @ torch.cat([current.twist, current.gain])
    free = torch.tensor([kinds.poses] * 6 + [kinds.gains] * 3)
    solved = torch.zeros(9, dtype=torch.float64)
    solved[free] = torch.linalg.solve(normal[free][:, free], right[free])
    twist = compose(current.twist, solved[:6])
    motion = float((twist @ metric @ twist).clamp_min(0).sqrt())
    bound = MAX_MOTION_SHARE * max(view.pinhole.width, view.pinhole.height)
    if motion > bound:
        twist = twist * (bound / motion)
    return Correction(twist, current.gain + solved[6:])


@torch.no_grad()
def rms_motion(scene: Scene, view: TrainView, correction: Correction) -> float:
    """Root mean square motion in pixels of the visible surface under a correction; 0 where none is visible."""
    _, out = scene.render(view)
    index = (out.alpha > 0.5).flatten().nonzero()[:, 0]
    moved = flow_jacobian(view, out.expected_depth().flatten()[index], index) @ correction.twist.to(view.t)
    return float(moved.square().sum(1).mean().sqrt()) if len(index) else 0.0


@torch.no_grad()
def psnr(scene: Scene, view: TrainView, correction: Correction, mask: Tensor) -> float:
    """PSNR (dB) of the corrected view's render against its photo, over pixels of `mask` (h, w) on the object in the uncorrected view."""
    inside = scene.inside(view, scene.render(view)[1].alpha) & mask
    corrected = correction.apply(view)
    error = (scene.render(corrected)[0] - scene.photo(corrected)).square().mean(0)[inside]
    return decibels(float(error.mean())) if len(error) else 0.0


def make_scene(surfels: object, light: object, masked: bool, background: Tensor) -> Scene:
    """The scene of the current surfels (`Surfels`) and light (`EnvironmentLight` or None)."""
    tables = None if light is None else light.prefilter()  # type: ignore[attr-defined]

    def render(view: TrainView) -> tuple[Tensor, Rendered]:
        out = rasterise(surfels, view)  # type: ignore[arg-type]
        return rendered_image(out.planes, view, tables) + background[:, None, None] * (1 - out.alpha), out

    return Scene(render, masked, background)
