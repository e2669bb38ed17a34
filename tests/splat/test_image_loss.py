"""The fused image losses against their PyTorch twins, value and gradient; SSIM also against scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from gsbake.splat import image_loss, losses
from gsbake.splat.projection import Pinhole


@pytest.mark.parametrize("shape", [(3, 40, 57), (3, 5, 4), (3, 1, 1)])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_colour(shape: tuple[int, int, int], share: float) -> None:
    g = torch.Generator().manual_seed(1)
    image, target = torch.rand(shape, generator=g), torch.rand(shape, generator=g)
    a, b = image.clone().requires_grad_(), image.double().clone().requires_grad_()
    fast, slow = image_loss.colour(a, target, share), losses.colour(b, target.double(), share)
    fast.backward()
    slow.backward()
    assert float(fast.detach()) == pytest.approx(float(slow.detach()), abs=2e-6)
    assert a.grad is not None and b.grad is not None
    assert (a.grad.double() - b.grad).norm() < 1e-3 * b.grad.norm()


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


def test_normal_consistency() -> None:
    g = torch.Generator().manual_seed(2)
    h, w = 45, 38
    depth = 3 + 0.3 * torch.rand(h, w, generator=g)
    alpha = torch.rand(h, w, generator=g)
    normals = torch.randn(3, h, w, generator=g) * 0.5
    mask = (torch.rand(h, w, generator=g) > 0.3).float()
    R = torch.linalg.qr(torch.randn(3, 3, generator=g))[0]
    view = Pinhole(w, h, 50.0, 60.0, 18.0, 25.0)
    fast_in = [x.clone().requires_grad_() for x in (depth, alpha, normals)]
    slow_in = [x.double().clone().requires_grad_() for x in (depth, alpha, normals)]
    fast = image_loss.normal_consistency(*fast_in, mask, R, view)
    slow = losses.normal_consistency(slow_in[2], slow_in[1], losses.depth_normals(slow_in[0], R.double(), view), mask.double())
    fast.backward()
    slow.backward()
    assert float(fast.detach()) == pytest.approx(float(slow.detach()), rel=1e-4)
    for a, b in zip(fast_in, slow_in, strict=True):
        assert a.grad is not None and b.grad is not None
        assert (a.grad.double() - b.grad).norm() < 1e-3 * b.grad.norm()


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
