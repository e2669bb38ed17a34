"""Pose and exposure corrections of photos, and the removal of their gauge freedom.

A twist (ω, τ) is applied to world→camera about the object's centre, the origin of the unit frame: R' = exp(ω) R, t' = t + τ. So its
rotation does not move the centre in the image, and its translation does not rotate. A gain is the logarithm of a factor on linear
colour per channel; above its linear segment the sRGB curve turns it into a factor on the encoded value plus .055 (IEC 61966-2-1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbake.geometry.cameras import Camera
from gsbake.surfels.views import TrainView

#: Offset and exponent of the sRGB curve above its linear segment.
SRGB_OFFSET, SRGB_EXPONENT = 0.055, 1 / 2.4


@dataclass(frozen=True)
class CorrectionKinds:
    """Which corrections are made: of poses, of exposure gains."""

    poses: bool
    gains: bool

    def __bool__(self) -> bool:
        return self.poses or self.gains


@dataclass(frozen=True)
class Correction:
    """`twist` (6,): ω in radians, τ in units of the unit frame, both in camera axes; `gain` (3,): log of the linear exposure."""

    twist: Tensor
    gain: Tensor

    @staticmethod
    def identity() -> Correction:
        """The correction without effect."""
        return Correction(torch.zeros(6, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def apply(self, view: TrainView) -> TrainView:
        """The view with the corrected pose and its photo at the common exposure (8-bit, clamped to white)."""
        rotation = rotation_matrix(self.twist[:3]) @ view.R.double().cpu()
        t = view.t.double().cpu() + self.twist[3:]
        r, t, centre = (x.to(view.R) for x in (rotation, t, -rotation.T @ t))
        rgb = view.rgb
        if self.gain.any():
            rgb = (255 * equalise_exposure(view.colour(), self.gain)).round().clamp(0, 255).to(torch.uint8)
        return replace(view, rgb=rgb, R=r, t=t, centre=centre)

    def apply_to_camera(self, camera: Camera) -> Camera:
        """The camera (unit frame) with the corrected pose."""
        return replace(camera, R=rotation_matrix(self.twist[:3]).numpy() @ camera.R, t=camera.t + self.twist[3:].numpy())


def rotation_matrix(omega: Tensor) -> Tensor:
    """Rotation matrix (3, 3) of a rotation vector (3,): the exponential of its cross-product matrix."""
    return torch.from_numpy(Rotation.from_rotvec(omega.numpy()).as_matrix())


def rotation_vector(rotation: Tensor) -> Tensor:
    """Rotation vector (3,) of a rotation matrix (3, 3)."""
    return torch.from_numpy(Rotation.from_matrix(rotation.numpy()).as_rotvec())


def compose(first: Tensor, second: Tensor) -> Tensor:
    """The twist (6,) that applies `first`, then `second`."""
    return torch.cat([rotation_vector(rotation_matrix(second[:3]) @ rotation_matrix(first[:3])), first[3:] + second[3:]])


def equalise_exposure(colour: Tensor, gain: Tensor) -> Tensor:
    """sRGB planes (3, h, w) of a photo divided by its exposure, log `gain` (3,) on linear colour; not clamped."""
    factor = torch.exp(-SRGB_EXPONENT * gain).to(colour)[:, None, None]
    return (colour + SRGB_OFFSET) * factor - SRGB_OFFSET


def remove_gauge(views: Sequence[TrainView], corrections: Sequence[Correction]) -> list[Correction]:
    """The corrections without their gauge freedom: a similarity transform of the scene and a common exposure, undetermined by photos.

    To first order, photo i moves the object by Rᵢᵀωᵢ and Rᵢᵀτᵢ in the unit frame, and τ along t changes its size by −τ·t/|t|²: the
    means over the photos of these seven and of the gains are subtracted.
    """
    rotation = torch.stack([v.R.double().cpu() for v in views])
    t = torch.stack([v.t.double().cpu() for v in views])
    twist, gain = torch.stack([c.twist for c in corrections]), torch.stack([c.gain for c in corrections])
    omega = twist[:, :3] - torch.einsum("nij,j->ni", rotation, torch.einsum("nji,nj->i", rotation, twist[:, :3]) / len(views))
    tau = twist[:, 3:] - torch.einsum("nij,j->ni", rotation, torch.einsum("nji,nj->i", rotation, twist[:, 3:]) / len(views))
    tau = tau - ((tau * t).sum(1) / (t * t).sum(1)).mean() * t
    gain = gain - gain.mean(0)
    return [Correction(torch.cat([a, b]), c) for a, b, c in zip(omega, tau, gain, strict=True)]
