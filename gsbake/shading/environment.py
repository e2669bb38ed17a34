"""The learnable environment light: a cube map of positive radiance.

Directions are in the unit frame of the surfels and cameras; faces and orientation as in `cubemap`. Light at infinity, without visibility
(METHOD §6).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray

from gsbake.errors import BadInputError
from gsbake.shading import cubemap, panorama
from gsbake.shading.cubemap import Array
from gsbake.shading.light_tables import LightTables, filter_cube

#: Radiance below this is stored as this: zero has no logarithm.
_DARKEST = 1e-6


class EnvironmentLight(torch.nn.Module):
    """Parameter `raw` (6, size, size, 3); radiance = softplus(raw)².

    Squared, so that a lamp much brighter than the room is within reach of Adam's fixed step, without an exponential's overshoot. Fitted to
    a shaded sphere for 600 steps at rate .016, the map was off by a mean of .069 stops (softplus .129, exponential .110) under a lamp of
    radiance 3 and .176 (.303, .185) under one of 60.
    """

    def __init__(self, size: int = 32, radiance: float = 0.8) -> None:
        super().__init__()
        self.raw = torch.nn.Parameter(_inverse(torch.full((6, size, size, 3), float(radiance))))

    @property
    def size(self) -> int:
        """Edge of a face in texels."""
        return int(self.raw.shape[1])

    def radiance(self) -> torch.Tensor:
        """Linear RGB radiance (6, size, size, 3), positive, differentiable."""
        return torch.nn.functional.softplus(self.raw).square()

    def prefilter(self) -> LightTables:
        """The lookups of the present light, differentiable; rebuild after every optimiser step."""
        return filter_cube(self.radiance())

    def equirectangular(
        self, height: int, rotation: NDArray[np.floating] | None = None, convention: panorama.Convention = "blender"
    ) -> NDArray[np.float32]:
        """The light as an image (height, 2·height, 3), linear RGB.

        `rotation` (3, 3) takes directions of the unit frame to the frame of the image (e.g. `Similarity.rotation` for Blender's Z-up
        world); None means the frames agree. `convention` says which pixel shows which direction of that frame, see `panorama`.
        """
        cut = max(1, math.ceil(self.size / height))
        dirs = panorama.directions(height, convention, cut).reshape(-1, 3)
        if rotation is not None:
            dirs = dirs @ np.asarray(rotation, dtype=np.float64)
        with torch.no_grad():
            values = cubemap.sample(self.radiance().cpu().numpy(), dirs)
        return values.reshape(height, cut, 2 * height, cut, 3).mean(axis=(1, 3)).astype(np.float32)

    def save(self, path: Path | str) -> None:
        """Write the radiance as safetensors (key `radiance`); the same radiance writes the same bytes."""
        # one key: safetensors writes several in an arbitrary order, which would change the file's digest
        meta = {"format": "linear RGB radiance in the unit frame; faces +X -X +Y -Y +Z -Z, OpenGL orientation"}
        safetensors.torch.save_file({"radiance": self.radiance().detach().cpu().contiguous()}, str(path), metadata=meta)

    @classmethod
    def load(cls, path: Path | str) -> EnvironmentLight:
        """Read what `save` wrote. Raises BadInputError when the file is not such a light."""
        try:
            radiance = safetensors.torch.load_file(str(path))["radiance"]
        except (OSError, KeyError, safetensors.SafetensorError) as error:
            raise BadInputError(f"{path} is not an environment light ({error}); train again or remove the file.") from error
        return cls.from_radiance(radiance)

    @classmethod
    def from_radiance(cls, radiance: torch.Tensor | NDArray[np.floating]) -> EnvironmentLight:
        """A light with the given radiance (6, N, N, 3), in any float type. Raises BadInputError on another shape or on values below 0."""
        cube = torch.as_tensor(radiance, dtype=torch.float32)
        if cube.ndim != 4 or cube.shape[0] != 6 or cube.shape[1] != cube.shape[2] or cube.shape[3] != 3 or cube.shape[1] < 4:
            raise BadInputError(f"An environment cube map has shape (6, N, N, 3) with N ≥ 4, not {tuple(cube.shape)}.")
        if not bool(torch.isfinite(cube).all()) or bool((cube < 0).any()):
            raise BadInputError("The environment holds radiance that is negative or not a number.")
        light = cls(int(cube.shape[1]))
        with torch.no_grad():
            light.raw.copy_(_inverse(cube))
        return light

    @classmethod
    def from_function(cls, function: Callable[[Array], Array], size: int = 32, subdivide: int = 4) -> EnvironmentLight:
        """A light from a function of unit directions (n, 3) to radiance (n, 3), averaged over subdivide² points per texel."""
        fine = size * subdivide
        values = np.asarray(function(cubemap.directions(fine).reshape(-1, 3)), dtype=np.float64).reshape(6, fine, fine, 3)
        angle = cubemap.solid_angles(fine)[..., None]
        parts = (6, size, subdivide, size, subdivide, -1)
        return cls.from_radiance((values * angle).reshape(parts).sum(axis=(2, 4)) / angle.reshape(parts).sum(axis=(2, 4)))

    @classmethod
    def from_equirectangular(
        cls,
        image: NDArray[np.floating],
        size: int = 32,
        rotation: NDArray[np.floating] | None = None,
        convention: panorama.Convention = "blender",
    ) -> EnvironmentLight:
        """A light from an image (h, w, 3) of linear RGB; `rotation` and `convention` as in `equirectangular`."""
        turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        cut = min(16, max(2, math.ceil(image.shape[0] / (2 * size))))
        return cls.from_function(lambda dirs: panorama.sample(image, dirs @ turn.T, convention), size, cut)


def _inverse(radiance: torch.Tensor) -> torch.Tensor:
    """The parameter whose softplus squared is `radiance`."""
    root = radiance.double().clamp_min(_DARKEST).sqrt()
    return (root + torch.log(-torch.expm1(-root))).float()
