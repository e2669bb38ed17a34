"""The state that training optimises: 2D Gaussian surfels, each with one sample of the signed distance field.

Per surfel: centre μ, quaternion (third axis = oriented normal, never flipped to a camera), two log-scales, SDF sample s, and either
spherical-harmonic colours (shading "colour") or base colour, roughness and metallic (shading "pbr"). One global sharpness γ. Systems
whose splats have an opacity of their own carry its logit as another attribute; the SDF sample then is only a record of the field.
(Zhu et al., Gaussian Splatting with Discretized SDF, ICCV 2025; Huang et al., 2D Gaussian Splatting, SIGGRAPH 2024.)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsbake.surfels import spherical_harmonics as harmonics
from gsbake.surfels.raster.reference import rotation_matrix
from gsbake.surfels.transfer import DEFAULT_TRANSFER, Transfer, transfer_by_name

#: Start values of roughness (.27) and metallic (.05) before the sigmoid. A smooth start lets reflections teach the light at once; from the
#: paper's .646 the light stays a blur and the surfaces stay rough (docs/decisions/0003-smooth-start.md).
ROUGHNESS_INIT, METALLIC_INIT = -1.0, -3.0
#: Larger scale of a surfel as a share of the distance to its neighbours: discs overlap without smearing. Training preserves it while
#: surfels cover the surface.
SCALE_TO_SPACING = 0.6
FORMAT = "gsbake surfels 1"


@dataclass
class Surfels:
    """All surfels of a scene; tensors have the surfel count n as first dimension, in the unit frame.

    `position` (n, 3), `quaternion` (n, 4) as (w, x, y, z), `log_scale` (n, 2), `sdf` (n,), `attributes`: "sh" (n, (degree+1)², 3) or
    "albedo" (n, 3), "roughness" (n,), "metallic" (n,) before the sigmoid, and "opacity" (n,) before the sigmoid where it does not follow
    from the SDF; `gamma` (1,); `transfer` turns sdf and gamma into opacity.
    """

    position: Tensor
    quaternion: Tensor
    log_scale: Tensor
    sdf: Tensor
    gamma: Tensor
    attributes: dict[str, Tensor]
    transfer: Transfer

    def __len__(self) -> int:
        return self.position.shape[0]

    @property
    def pbr(self) -> bool:
        """Whether materials (rather than plain colours) are carried."""
        return "albedo" in self.attributes

    def opacity(self) -> Tensor:
        """Opacity (n,), from the SDF samples unless the surfels have one of their own."""
        if "opacity" in self.attributes:
            return torch.sigmoid(self.attributes["opacity"])
        return self.transfer.opacity(self.sdf, self.gamma)

    @property
    def peak_opacity(self) -> float:
        """The largest opacity that a surfel can have."""
        return 1.0 if "opacity" in self.attributes else self.transfer.peak

    def normal(self) -> Tensor:
        """Oriented unit normals (n, 3)."""
        return rotation_matrix(self.quaternion)[:, :, 2]

    @property
    def scale(self) -> Tensor:
        """Standard deviations (n, 2) along the two tangents."""
        return self.log_scale.exp()

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        own = {k: getattr(self, k) for k in ("position", "quaternion", "log_scale", "sdf", "gamma")}
        return own | {f"attributes.{k}": v for k, v in self.attributes.items()}

    @staticmethod
    def from_tensors(tensors: dict[str, Tensor], transfer: Transfer) -> Surfels:
        """The surfels whose `tensors()` and transfer these are."""
        attributes = {k.removeprefix("attributes."): v for k, v in tensors.items() if k.startswith("attributes.")}
        return Surfels(attributes=attributes, transfer=transfer, **{k: v for k, v in tensors.items() if "." not in k})

    def concat(self, more: Surfels) -> Surfels:
        """These surfels, then `more`; sharpness and transfer stay this one's."""
        other = more.tensors()
        return Surfels.from_tensors({k: v if k == "gamma" else torch.cat([v, other[k]]) for k, v in self.tensors().items()}, self.transfer)

    def features(self, camera_centre: Tensor) -> Tensor:
        """What is blended per surfel: rgb (n, 3) seen from `camera_centre` (3,), or base colour, roughness, metallic (n, 5)."""
        a = self.attributes
        if self.pbr:
            return torch.sigmoid(torch.cat([a["albedo"], a["roughness"][:, None], a["metallic"][:, None]], 1))
        return harmonics.colours(a["sh"], self.position, camera_centre)

    def select(self, index: Tensor) -> Surfels:
        """The surfels at `index` (indices or a mask)."""
        return Surfels(
            self.position[index], self.quaternion[index], self.log_scale[index], self.sdf[index], self.gamma,
            {k: v[index] for k, v in self.attributes.items()}, self.transfer,
        )  # fmt: skip

    def to(self, device: str | torch.device) -> Surfels:
        """The surfels with all tensors on `device`."""
        return Surfels.from_tensors({k: v.to(device) for k, v in self.tensors().items()}, self.transfer)

    def save(self, path: Path) -> None:
        """Write as safetensors; the transfer is named in the metadata unless it is the default."""
        # one key for both: with several their order in the file is by chance, and its digest with it
        kind = FORMAT if self.transfer.name == DEFAULT_TRANSFER else f"{FORMAT}, {self.transfer.name}"
        save_file({k: v.detach().contiguous().cpu() for k, v in self.tensors().items()}, str(path), {"format": kind})

    @staticmethod
    def load(path: Path) -> Surfels:
        """Read what `save` wrote; BadInputError for a transfer this version does not know."""
        with safe_open(str(path), "pt") as file:
            all_ = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 (safetensors has no iterator)
            kind = (file.metadata() or {}).get("format", FORMAT)
        return Surfels.from_tensors(all_, transfer_by_name(kind.removeprefix(FORMAT).removeprefix(", ") or DEFAULT_TRANSFER))


def quaternion_from_normal(normals: Tensor) -> Tensor:
    """Shortest rotations (n, 4) that turn +z to the unit normals (n, 3)."""
    w = 1 + normals[:, 2]
    q = torch.stack([w, -normals[:, 1], normals[:, 0], torch.zeros_like(w)], 1)
    flipped = w < 1e-6  # −z: half a turn about x
    q[flipped] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=normals.dtype)
    return torch.nn.functional.normalize(q, dim=1)


def create(
    points: np.ndarray,
    normals: np.ndarray,
    spacing: np.ndarray,
    colours: np.ndarray | None,
    shading: str,
    sh_degree: int,
    sdf: float,
    gamma: float,
    transfer: str = DEFAULT_TRANSFER,
) -> Surfels:
    """New surfels at points (n, 3) with unit normals (n, 3), neighbour distance `spacing` (n,) and sRGB colours (n, 3) in 0..1 or
    None (grey)."""
    n = len(points)
    position = torch.from_numpy(np.ascontiguousarray(points, np.float32))
    normal = torch.from_numpy(np.ascontiguousarray(normals, np.float32))
    rgb = torch.full((n, 3), 0.5) if colours is None else torch.from_numpy(np.ascontiguousarray(colours, np.float32))
    attributes: dict[str, Tensor]
    if shading == "pbr":
        linear = ((rgb + 0.055) / 1.055).clamp_min(0.04) ** 2.4
        attributes = {
            "albedo": torch.logit(linear.clamp(0.02, 0.98)),
            "roughness": torch.full((n,), ROUGHNESS_INIT),
            "metallic": torch.full((n,), METALLIC_INIT),
        }
    else:
        sh = torch.zeros(n, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = (rgb - 0.5) / harmonics.SH0
        attributes = {"sh": sh}
    log_scale = torch.from_numpy(np.log(SCALE_TO_SPACING * np.maximum(spacing, 1e-5)).astype(np.float32))[:, None].repeat(1, 2)
    rotation, samples = quaternion_from_normal(normal), torch.full((n,), sdf)
    return Surfels(position, rotation, log_scale, samples, torch.tensor([gamma]), attributes, transfer_by_name(transfer))
