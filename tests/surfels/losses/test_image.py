"""The fused image losses against their PyTorch twins in float64, value and gradient; SSIM also against scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from gsbake.kernels import threads as kernel_threads
from gsbake.shading.environment import EnvironmentLight
from gsbake.shading.light_tables import LightTables
from gsbake.surfels.gbuffer import rendered_image
from gsbake.surfels.losses import photometric as similarity
from gsbake.surfels.losses import terms as losses
from gsbake.surfels.losses.image import image_losses
from gsbake.surfels.losses.terms import ImageWeights
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.views import TrainView

ALL = ImageWeights(0.2, normal=0.7, mask=0.3, distortion=3.0, smoothness=0.5)
#: More rows than one strip of any pass, and widths that are no multiple of eight.
SIZES = [(45, 38), (3, 5), (2, 2), (140, 24)]


def random_view(height: int, width: int) -> TrainView:
    """A photo of noise with a mask of all values, from a turned camera."""
    g = torch.Generator().manual_seed(2)
    rgb, mask = (torch.randint(0, 256, (*c, height, width), generator=g, dtype=torch.uint8) for c in ((3,), ()))
    turned = torch.linalg.qr(torch.randn(3, 3, generator=g))[0]
    lens = Pinhole(width, height, 1.3 * width, 1.5 * width, 0.45 * width, 0.6 * height)
    return TrainView("noise", rgb, mask, turned, torch.zeros(3), torch.zeros(3), lens)


def random_planes(channels: int, height: int, width: int) -> Tensor:
    """Blended planes with empty, thin and opaque pixels."""
    g = torch.Generator().manual_seed(3)
    planes = torch.rand(channels + 6, height, width, generator=g)
    alpha = planes[channels + 4]
    alpha[alpha < 0.1] = 0
    alpha[alpha > 0.95] = 0.999
    planes[channels - 3 : channels] = 0.5 * torch.randn(3, height, width, generator=g) * alpha
    planes[: channels - 3] *= alpha
    planes[channels] = alpha * (3 + 0.3 * torch.rand(height, width, generator=g))
    return planes


def close(fast: Tensor | None, slow: Tensor | None, bound: float) -> bool:
    """Relative difference (Frobenius) below the bound; where the twin is zero, zero."""
    assert fast is not None and slow is not None
    return bool((fast.double() - slow).norm() <= bound * slow.norm())


@pytest.mark.parametrize("shape", [(3, 40, 57), (3, 5, 4), (3, 1, 1), (3, 150, 9)])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_colour(shape: tuple[int, int, int], share: float) -> None:
    g = torch.Generator().manual_seed(1)
    _, h, w = shape
    image, alpha, back = torch.rand(shape, generator=g), torch.rand(h, w, generator=g), torch.rand(3, generator=g)
    view = random_view(h, w)
    assert view.mask is not None
    grad = torch.empty(shape)
    flat = [x.reshape(-1).numpy() for x in (image, alpha, view.rgb, view.mask, back)]
    fast = similarity.colour_loss(*flat, h, w, share, grad.view(-1).numpy())
    a, cover, behind = image.double().requires_grad_(), view.mask.double() / 255, back.double()[:, None, None]
    slow = losses.colour_loss(a + behind * (1 - alpha.double()), view.rgb.double() / 255 * cover + behind * (1 - cover), share)
    slow.backward()
    assert fast == pytest.approx(float(slow.detach()), abs=1e-6)
    assert close(grad, a.grad, 1e-5)


def test_colour_where_the_pictures_agree() -> None:
    """Around an object both pictures are the same flat background: differences of large numbers, which must stay near nothing."""
    h = w = 96
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    disc = ((y - 48) ** 2 + (x - 48) ** 2 < 25**2).float()
    view, back = random_view(h, w), torch.tensor([0.9, 0.5, 0.13])
    image, grad = 0.3 * torch.rand(3, h, w, generator=torch.Generator().manual_seed(1)) * disc, torch.empty(3, h, w)
    flat = [v.reshape(-1).numpy() for v in (image, disc, view.rgb, (255 * disc).byte(), back)]
    fast = similarity.colour_loss(*flat, h, w, 0.2, grad.view(-1).numpy())
    a, behind = image.double().requires_grad_(), back.double()[:, None, None] * (1 - disc.double())
    slow = losses.colour_loss(a + behind, view.rgb.double() / 255 * disc + behind, 0.2)
    slow.backward()
    assert fast == pytest.approx(float(slow.detach()), abs=1e-5)
    assert close(grad, a.grad, 1e-4)


def test_ssim_is_the_standard_one() -> None:
    """Inside the frame, where borders play no part, the twin equals scikit-image's Gaussian SSIM."""
    rng = np.random.default_rng(0)
    a = rng.random((64, 64))
    b = np.clip(a + 0.2 * rng.standard_normal((64, 64)), 0, 1)
    _, full = structural_similarity(a, b, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True)
    pad = np.zeros((84, 84))
    x, y = pad.copy(), pad.copy()
    x[10:-10, 10:-10], y[10:-10, 10:-10] = a, b
    total = float(losses.ssim(torch.from_numpy(a)[None], torch.from_numpy(b)[None]))
    assert total == pytest.approx(full.mean(), abs=0.02)  # borders differ
    inner = float(losses.ssim(torch.from_numpy(a[12:-12, 12:-12])[None], torch.from_numpy(b[12:-12, 12:-12])[None]))
    assert inner == pytest.approx(full[12:-12, 12:-12].mean(), abs=0.02)


def image_twin(
    planes: Tensor, tables: LightTables | None, view: TrainView, masked: bool, background: Tensor, weights: ImageWeights
) -> tuple[Tensor, Tensor]:
    turned = TrainView(view.name, view.rgb, view.mask, view.R.to(planes), view.t, view.centre, view.pinhole)
    shaded = rendered_image(planes, turned, tables)
    return losses.image_losses(planes, shaded, turned, masked, background.to(planes), weights, tables is not None)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize(
    "weights",
    [ImageWeights(0.2), ImageWeights(0.0, normal=1.0), ImageWeights(1.0, mask=1.0), ImageWeights(0.2, distortion=9.0), ALL],
    ids=["colour", "normal", "mask", "distortion", "all"],
)
def test_image(size: tuple[int, int], masked: bool, weights: ImageWeights) -> None:
    view, planes, back = random_view(*size), random_planes(6, *size), torch.tensor([0.1, 0.5, 0.9])
    a, b = planes.clone().requires_grad_(), planes.double().requires_grad_()
    fast, colour = image_losses(a, None, view, masked, back, weights)
    slow, colour_too = image_twin(b, None, view, masked, back, weights)
    assert float(fast.detach()) == pytest.approx(float(slow.detach()), rel=1e-5, abs=1e-6)
    assert float(colour) == pytest.approx(float(colour_too.detach()), abs=1e-6)
    (3 * fast).backward()
    (3 * slow).backward()
    assert a.grad is not None and b.grad is not None
    for i in range(len(planes)):
        assert close(a.grad[i], b.grad[i], 1e-4), i


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("weights", [ImageWeights(0.2), ImageWeights(0.2, smoothness=1.0), ALL], ids=["colour", "smoothness", "all"])
def test_image_of_materials(size: tuple[int, int], masked: bool, weights: ImageWeights) -> None:
    view, planes, back = random_view(*size), random_planes(8, *size), torch.tensor([0.1, 0.5, 0.9])
    light = EnvironmentLight(8)
    with torch.no_grad():
        light.raw += torch.randn(light.raw.shape, generator=torch.Generator().manual_seed(5))
    tables = light.prefilter()
    found = []
    for dtype, call in ((torch.float32, image_losses), (torch.float64, image_twin)):
        leaf, table = planes.to(dtype, copy=True).requires_grad_(), tables.table.detach().to(dtype).requires_grad_()
        total, colour = call(leaf, LightTables(table, tables.layout), view, masked, back, weights)
        total.backward()
        assert leaf.grad is not None
        found.append((total.detach(), colour.detach(), table.grad, leaf.grad))
    fast, slow = found
    assert float(fast[0]) == pytest.approx(float(slow[0]), rel=1e-5, abs=1e-5)
    assert float(fast[1]) == pytest.approx(float(slow[1]), abs=1e-5)
    assert close(fast[2], slow[2], 1e-3)
    for i in range(len(planes)):
        assert close(fast[3][i], slow[3][i], 1e-3), i


def test_image_where_nothing_is() -> None:
    """No pixel is shaded, none has a depth: gradients are there and finite."""
    view, planes = random_view(20, 17), torch.zeros(14, 20, 17).requires_grad_()
    image_losses(planes, EnvironmentLight(8).prefilter().detach(), view, True, torch.ones(3), ALL)[0].backward()
    assert planes.grad is not None and bool(torch.isfinite(planes.grad).all()) and float(planes.grad.abs().max()) > 0


def test_depth_normals_of_a_plane() -> None:
    """A tilted plane n·p = d gives the same normal everywhere inside the frame, facing the camera."""
    n = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64), dim=0)
    view = Pinhole(30, 20, 40.0, 44.0, 14.0, 11.0)
    x = (torch.arange(30, dtype=torch.float64) + 0.5 - 14) / 40
    y = (torch.arange(20, dtype=torch.float64)[:, None] + 0.5 - 11) / 44
    depth = -2.0 / (n[0] * x + n[1] * y + n[2])
    R = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))[0]
    inside = losses.depth_normals(depth, R, view)[:, 1:-1, 1:-1]
    assert torch.allclose(inside, (R.T @ n)[:, None, None].expand_as(inside), atol=1e-9)


def test_the_number_of_threads_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    view, planes, back = random_view(300, 31), random_planes(8, 300, 31), torch.tensor([0.1, 0.5, 0.9])
    tables = EnvironmentLight(8).prefilter().detach()
    found = []
    for count in (1, 3):
        monkeypatch.setattr(kernel_threads, "_configured", count)
        leaf = planes.clone().requires_grad_()
        total, _ = image_losses(leaf, tables, view, True, back, ALL)
        total.backward()
        found.append((total.detach(), leaf.grad))
    (one, grad), (three, grad_too) = found
    assert grad is not None and grad_too is not None and torch.equal(one, three) and torch.equal(grad, grad_too)
