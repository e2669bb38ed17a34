"""Corrections of a photo: a small rigid motion of the object in its camera and an exposure gain, and what all photos share of them.

A twist (ω, τ) acts on the left of world→camera about the object's centre, which is the origin of the unit frame: R' = exp(ω) R, t' = t + τ.
So its rotation does not move the centre in the picture, and its translation turns nothing. A gain is the logarithm of a factor on linear
light per colour channel; above its toe the sRGB curve turns it into a factor on the coded value plus .055 (IEC 61966-2-1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbake.geometry.cameras import Camera
from gsbake.surfels.training.views import TrainView

#: Offset and exponent of the sRGB curve.
OFFSET, POWER = 0.055, 1 / 2.4


@dataclass(frozen=True)
class Correction:
    """`twist` (6,): ω in radians, τ in the unit frame's length, both along the camera's axes; `gain` (3,): log of the linear exposure."""

    twist: Tensor
    gain: Tensor

    @staticmethod
    def none() -> Correction:
        """The correction that changes nothing."""
        return Correction(torch.zeros(6, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def of(self, view: TrainView) -> TrainView:
        """The view with its camera moved and its photo brought to the common exposure (8-bit; brighter than white is white)."""
        rotation = rotated(self.twist[:3]) @ view.R.double().cpu()
        t = view.t.double().cpu() + self.twist[3:]
        r, t, centre = (x.to(view.R) for x in (rotation, t, -rotation.T @ t))
        rgb = view.rgb
        if self.gain.any():
            rgb = (255 * equalised(view.colour(), self.gain)).round().clamp(0, 255).to(torch.uint8)
        return replace(view, rgb=rgb, R=r, t=t, centre=centre)

    def camera(self, camera: Camera) -> Camera:
        """The camera (unit frame) moved."""
        return replace(camera, R=rotated(self.twist[:3]).numpy() @ camera.R, t=camera.t + self.twist[3:].numpy())


def rotated(omega: Tensor) -> Tensor:
    """Rotation matrix (3, 3) of a rotation vector (3,): exp of its cross-product matrix."""
    return torch.from_numpy(Rotation.from_rotvec(omega.numpy()).as_matrix())


def turned_by(rotation: Tensor) -> Tensor:
    """Rotation vector (3,) of a rotation matrix (3, 3)."""
    return torch.from_numpy(Rotation.from_matrix(rotation.numpy()).as_rotvec())


def then(first: Tensor, second: Tensor) -> Tensor:
    """The twist (6,) that does what `first` and then `second` do."""
    return torch.cat([turned_by(rotated(second[:3]) @ rotated(first[:3])), first[3:] + second[3:]])


def equalised(colour: Tensor, gain: Tensor) -> Tensor:
    """sRGB planes (3, h, w) of a photo that was exposed `gain` (3,) too much, at the common exposure; not clipped."""
    factor = torch.exp(-POWER * gain).to(colour)[:, None, None]
    return (colour + OFFSET) * factor - OFFSET


def without_common(views: Sequence[TrainView], corrections: Sequence[Correction]) -> list[Correction]:
    """The corrections without what all photos share: a similarity of the whole scene and one exposure, which no picture can tell.

    To first order, photo i moves the object by Rᵢᵀωᵢ and Rᵢᵀτᵢ in the unit frame, and τ along t changes its size by −τ·t/|t|²: the
    means over the photos of these seven and of the gains are taken away.
    """
    rotation = torch.stack([v.R.double().cpu() for v in views])
    t = torch.stack([v.t.double().cpu() for v in views])
    twist, gain = torch.stack([c.twist for c in corrections]), torch.stack([c.gain for c in corrections])
    omega = twist[:, :3] - torch.einsum("nij,j->ni", rotation, torch.einsum("nji,nj->i", rotation, twist[:, :3]) / len(views))
    tau = twist[:, 3:] - torch.einsum("nij,j->ni", rotation, torch.einsum("nji,nj->i", rotation, twist[:, 3:]) / len(views))
    tau = tau - ((tau * t).sum(1) / (t * t).sum(1)).mean() * t
    gain = gain - gain.mean(0)
    return [Correction(torch.cat([a, b]), c) for a, b, c in zip(omega, tau, gain, strict=True)]
