"""The optimiser of the light."""

from __future__ import annotations

import numpy as np
import torch

from gsbake.materials.light_optimiser import LightOptimiser
from gsbake.materials.options import FitOptions

OPTIONS = FitOptions()


def test_a_step_is_that_of_adam() -> None:
    """With a constant gradient g both bias-corrected moments are g and g², so each step is the learning rate."""
    lit = LightOptimiser(4, OPTIONS)
    before = lit.light.raw.detach().clone()
    for decay in (1.0, 0.5):
        lit.step((lit.light.raw * 3).sum(), decay)
    torch.testing.assert_close(lit.light.raw.detach(), before - 1.5 * OPTIONS.light_rate, rtol=1e-4, atol=1e-5)


def test_a_new_light_starts_without_momentum() -> None:
    lit = LightOptimiser(4, OPTIONS)
    lit.step(lit.light.raw.sum(), 1.0)
    lit.replace(np.full((6, 4, 4, 3), 0.5, np.float32))
    np.testing.assert_allclose(lit.radiance(), 0.5, rtol=1e-4)
    lit.step((lit.light.raw * 0).sum(), 1.0)
    np.testing.assert_allclose(lit.radiance(), 0.5, rtol=1e-4)
