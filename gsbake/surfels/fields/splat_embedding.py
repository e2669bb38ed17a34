"""Embeddings of the surfels as features of a field, after *SplatSDF* (Li et al. 2024).

A network reads the attributes of the nearest surfels and the offset to them; its outputs are added with Gaussian weights, so that they
vanish away from the surfels, the anchors of the surface. The anchors are a copy of the surfels, renewed a few times in a run: they are part
of the field, which so is the same after a resume.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsbake.surfels.fields.heads import Network
from gsbake.surfels.model import Surfels
from gsbake.surfels.spacing import typical_spacing

#: Surfels that are blended at a point, and numbers of an anchor: normal, opacity, log-scales.
NEIGHBOURS, ATTRIBUTES = 4, 6
#: Width of the network, and standard deviation of the weights in spacings.
WIDTH, REACH = 16, 1.5


class SplatEmbedding:
    """`anchors` (m, 3), their `attributes` (m, 6), the spacing (1,), and the network."""

    def __init__(self, features: int, generator: torch.Generator) -> None:
        """A network of 9 inputs and `features` outputs, which are 0 at first."""
        self.network = Network(3 + ATTRIBUTES, WIDTH, 1, features, generator)
        self.features = features
        self.set(torch.zeros(0, 3), torch.zeros(0, ATTRIBUTES), torch.ones(1))

    def set(self, anchors: Tensor, attributes: Tensor, spacing: Tensor) -> None:
        """Take these anchors."""
        self.anchors, self.attributes, self.spacing = anchors, attributes, spacing
        self.tree = cKDTree(anchors.numpy().astype(np.float64)) if len(anchors) else None

    @torch.no_grad()
    def renew(self, surfels: Surfels) -> None:
        """Copy the finite surfels."""
        opacity, scale = surfels.opacity()[:, None], surfels.log_scale / 4
        attributes = torch.cat([surfels.normal(), opacity, scale], 1).cpu()
        position = surfels.position.cpu()
        fine = torch.isfinite(position).all(1) & torch.isfinite(attributes).all(1)
        self.set(position[fine].clone(), attributes[fine], torch.tensor([max(typical_spacing(surfels), 1e-6)]))

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Features (n, f) and their Jacobian (n, 3, f)."""
        n, k = len(points), min(NEIGHBOURS, len(self.anchors))
        if self.tree is None or not n:
            return points.new_zeros(n, self.features), points.new_zeros(n, 3, self.features)
        found = self.tree.query(points.detach().cpu().numpy().astype(np.float64), k=range(1, k + 1), workers=-1)[1]
        index = torch.from_numpy(np.asarray(found))
        reach = REACH * self.spacing.to(points)
        offset = (points[:, None] - self.anchors[index].to(points)) / reach
        inputs = torch.cat([offset, self.attributes[index].to(points)], 2).view(n * k, -1)
        slope = torch.zeros(3, inputs.shape[1], dtype=points.dtype)
        slope[:, :3] = torch.eye(3, dtype=points.dtype) / reach
        out, jacobian = self.network.with_jacobian(inputs, slope.expand(n * k, 3, -1))
        out, jacobian = out.view(n, k, -1), jacobian.view(n, k, 3, -1)
        weight = torch.exp(-0.5 * (offset**2).sum(2))
        turn = -offset / reach * weight[:, :, None]
        blended = (weight[:, :, None] * out).sum(1)
        return blended, (weight[:, :, None, None] * jacobian + turn[..., None] * out[:, :, None]).sum(1)
