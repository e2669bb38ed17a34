"""Lights that move with respect to the object: of a turntable, which turns the object under a light that stands, and on the camera.

Photos of an object on a turntable look like photos that were taken around it, but their light turns with the camera. Seen from the object,
the light of photo k is the light of the first photo turned by R_kᵀ, where R_k maps directions of the object's frame to those of the frame
in which the light stands:

    turntable    R_k: the turn about the table's axis by the azimuth of camera k, back to that of the first one
    camera       R_k: the rotation of camera k, relative to the first one (a flash)

The camera stands in one direction from the table, and what is up stays up. So an object that was laid down differently, whose photos have
another axis of the table, sees the same light, turned once more. A rotation of a cube map is a sparse matrix, the same for all steps.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.geometry.cameras import Camera
from gsbake.geometry.turntable import Turntable, find_turntable
from gsbake.shading.cubemap import directions, interpolation_matrix

Motion = Literal["static", "turntable", "camera"]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class LightMotion:
    """How a light moves, and the `rotations` (photos, 3, 3) to its frame; None where it stands."""

    motion: Motion = "static"
    rotations: Doubles | None = None

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        body = {"motion": self.motion, "rotations": None if self.rotations is None else self.rotations.tolist()}
        path.write_bytes(json.dumps(body).encode())

    @classmethod
    def load(cls, path: Path) -> LightMotion:
        """Read what `save` wrote; a light that stands where there is no file. Raises BadInputError for another file."""
        if not path.exists():
            return cls()
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            rotations = None if found["rotations"] is None else np.array(found["rotations"], np.float64).reshape(-1, 3, 3)
            motion: Motion = found["motion"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BadInputError(f"'{path}' does not say how a light moves ({error}); bake again.") from error
        return cls(motion, rotations)


def light_rotations(cameras: Sequence[Camera], motion: Motion, table: Turntable | None = None) -> Doubles | None:
    """Rotations (n, 3, 3) from the object's frame to that of the light, for each camera; None for a light that stands, or where there is no
    turntable before the cameras. `table` is that turntable, where it is known already."""
    if motion == "static" or len(cameras) < 2:
        return None
    if motion == "camera":
        to_room = np.stack([camera.R for camera in cameras])
    elif (table := table or find_turntable(cameras)) is not None:
        to_room = table.to_room(cameras)
    else:
        return None
    return np.asarray(to_room[0].T @ to_room)


def rotated(radiance: torch.Tensor, to_light: Doubles | None) -> torch.Tensor:
    """The light `radiance` (6, s, s, 3), which stands in its frame, in the frame of the object; differentiable."""
    if to_light is None:
        return radiance
    size, key = int(radiance.shape[1]), np.ascontiguousarray(to_light, np.float64).tobytes()
    return _Rotation.apply(radiance.reshape(-1, 3), size, key).reshape(radiance.shape)


@lru_cache(maxsize=512)
def rotation_matrix(size: int, to_light: bytes) -> scipy.sparse.csr_matrix:
    """Sparse matrix (6·size², 6·size²) that turns a flattened cube map from the light's frame to the object's; `to_light` are the bytes of
    a rotation in float64."""
    around = directions(size).reshape(-1, 3) @ np.frombuffer(to_light).reshape(3, 3).T
    return interpolation_matrix(size, around).astype(np.float32)


class _Rotation(torch.autograd.Function):
    """Product of a rotation matrix and a flattened cube map."""

    @staticmethod
    def forward(ctx: Any, cube: torch.Tensor, size: int, to_light: bytes) -> torch.Tensor:
        ctx.size, ctx.to_light = size, to_light
        return torch.from_numpy(rotation_matrix(size, to_light) @ cube.detach().numpy())

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return torch.from_numpy(rotation_matrix(ctx.size, ctx.to_light).T @ gradient.numpy()), None, None


def mean_radiance(radiance: NDArray[Any], rotations: Sequence[Doubles | None]) -> NDArray[np.float32]:
    """The mean over photos of the light (6, s, s, 3) in the object's frame."""
    moving = [r for r in rotations if r is not None]
    if not moving:
        return np.asarray(radiance, np.float32)
    light = torch.from_numpy(np.ascontiguousarray(radiance, np.float32))
    standing = (len(rotations) - len(moving)) * light
    total = standing + sum(rotated(light, r) for r in moving)
    return np.asarray((total / len(rotations)).numpy())
