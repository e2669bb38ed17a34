"""Extreme scenes for hypothesis: any scale, sharpness, SDF value, opacity and field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from hypothesis import strategies as st
from torch import Tensor

from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.raster.rasterise import Rendered, render
from gsbake.surfels.transfer import TRANSFERS, Transfer

SPECIAL_SDF = (0.0, 1e-30, 1e-3, 1.0, 1e6, -1e6)


@dataclass
class Scene:
    """Leaf tensors by name, the pose, the intrinsics and the transfer function."""

    leaves: dict[str, Tensor]
    rotation: Tensor
    translation: Tensor
    view: Pinhole
    transfer: Transfer

    def render(self) -> Rendered:
        """Render with the opacity from SDF samples and sharpness."""
        x = self.leaves
        opacity = self.transfer.opacity(x["sdf"], x["gamma"])
        return render(x["position"], x["quaternion"], x["log_scale"], opacity, x["features"], self.rotation, self.translation, self.view)

    def backward(self, out: Rendered, factor: float = 1.0) -> dict[str, Tensor]:
        """Gradients of all leaves and of the pose, by name."""
        loss = out.features.sum() + out.depth.sum() + out.distortion.sum() + out.alpha.sum() + out.expected_depth().sum()
        if loss.requires_grad:
            (factor * loss).backward()
        named = self.leaves | {"rotation": self.rotation, "translation": self.translation}
        return {k: v.grad for k, v in named.items() if v.grad is not None}


def build(
    n: int,
    seed: int,
    scale: tuple[float, float],
    spread: float,
    distance: float,
    gamma: float,
    transfer: str,
    fov: float,
    size: tuple[int, int],
) -> Scene:
    """A scene of n surfels: log10 of the scales in the range `scale`, centres with standard deviation `spread` at `distance`."""
    g = torch.Generator().manual_seed(seed)
    special = torch.tensor(SPECIAL_SDF)[torch.randint(len(SPECIAL_SDF), (n,), generator=g)]
    near_zero = torch.randn(n, generator=g) / gamma
    leaves = {
        "position": torch.randn(n, 3, generator=g) * spread,
        "quaternion": torch.randn(n, 4, generator=g),
        "log_scale": math.log(10) * (scale[0] + (scale[1] - scale[0]) * torch.rand(n, 2, generator=g)),
        "sdf": torch.where(torch.rand(n, generator=g) < 0.3, special, near_zero),
        "gamma": torch.tensor([gamma]),
        "features": torch.rand(n, 3, generator=g),
    }
    if n:
        leaves["quaternion"][0] = 0  # a quaternion without direction
    focal = size[0] / 2 / math.tan(math.radians(fov) / 2)
    view = Pinhole(size[0], size[1], focal, 1.1 * focal, 0.4 * size[0], 0.7 * size[1])
    for x in leaves.values():
        x.requires_grad_()
    rotation, translation = torch.eye(3).requires_grad_(), torch.tensor([0.0, 0.0, distance]).requires_grad_()
    return Scene(leaves, rotation, translation, view, TRANSFERS[transfer])


def scenes() -> st.SearchStrategy[Scene]:
    """All parameters of `build`, over many orders of magnitude."""
    exponent = st.floats(-8, 4)
    return st.builds(
        build,
        n=st.sampled_from([0, 1, 2, 7, 60]),
        seed=st.integers(0, 2**31),
        scale=st.tuples(exponent, exponent),
        spread=st.sampled_from([0.0, 1e-6, 0.3, 3.0, 1e3]),
        distance=st.sampled_from([-3.0, 0.0, 0.02, 0.5, 3.0, 1e4]),
        gamma=st.floats(-6, 6).map(lambda e: 10.0**e),
        transfer=st.sampled_from(sorted(TRANSFERS)),
        fov=st.floats(1, 170),
        size=st.tuples(st.sampled_from([1, 3, 16, 33]), st.sampled_from([1, 2, 16, 50])),
    )
