"""The discretized field: one SDF sample per surfel (Zhu et al., Gaussian Splatting with Discretized SDF, ICCV 2025).

Each surfel, projected by its own sample (μ' = μ − s n), is an oriented point of the surface. Between surfels the field is the moving least
squares of their planes, f(x) = Σ wᵢ nᵢ·(x − μ'ᵢ) / Σ wᵢ with Gaussian weights over the nearest ones (Kolluri, *Provably good moving least
squares*, SODA 2005); it is a distance near the surface only. Meshes are extracted from `imls`, the same field with compact support.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from gsbake.geometry.sparse_lattice import BlockLattice
from gsbake.imaging.distance import distance_to_zero
from gsbake.surfels.field import Field, TrainingStep
from gsbake.surfels.fields.imls import imls_field
from gsbake.surfels.losses import terms as losses
from gsbake.surfels.losses.projection import projection_loss
from gsbake.surfels.model import Surfels
from gsbake.surfels.oriented_points import oriented_points
from gsbake.surfels.spacing import typical_spacing
from gsbake.surfels.views import TrainView

#: Nearest samples that are blended at a point.
NEIGHBOURS = 12
#: Standard deviation of the weights in units of the distance between neighbouring samples.
WIDTH = 0.6


class SamplesField(Field):
    """The SDF samples that the surfels carry; it has no parameters of its own."""

    name = "samples"

    def __init__(self, surfels: Surfels, loss: Any, train: Any = None, fine_tuning: bool = False) -> None:
        """`loss` and `train` are the profile's sections: the weights of the median and projection losses, and the unit of the sharpness.

        With `fine_tuning` opacity keeps the width that training has ended with.
        """
        self.surfels, self.loss, self.train, self.fine_tuning = surfels, loss, train, fine_tuning
        self._index: tuple[cKDTree, Tensor, Tensor, Tensor] | None = None
        self._distances: dict[tuple[str, int], Tensor] = {}

    def follow(self, surfels: Surfels) -> None:
        """Read the samples of these surfels."""
        self.surfels, self._index = surfels, None

    def distance(self, surfels: Surfels) -> Tensor:
        """The SDF samples (n,) themselves."""
        return surfels.sdf

    def opacity(self, surfels: Surfels) -> Tensor:
        """Opacity (n,). With the sharpness in spacings the median loss alone moves it: photos would sharpen a band of surfels until it is
        transparent, since fewer opaque layers always explain them better."""
        if self.train is None or self.train.sharpness == "unit":
            return surfels.opacity()
        return surfels.transfer.opacity(surfels.sdf, surfels.gamma.detach())

    def project_surfels(self, surfels: Surfels) -> Tensor:
        """μ − s n (n, 3)."""
        return surfels.position - surfels.sdf[:, None] * surfels.normal()

    def _samples(self) -> tuple[cKDTree, Tensor, Tensor, Tensor]:
        """Search tree, projected centres (m, 3), normals (m, 3) and inverse variances (m,) of the finite samples."""
        if self._index is None:
            with torch.no_grad():
                centres, normals = self.project_surfels(self.surfels), self.surfels.normal()
                fine = torch.isfinite(centres).all(1) & torch.isfinite(normals).all(1)
                centres, normals = centres[fine].cpu(), normals[fine].cpu()
            tree = cKDTree(centres.numpy().astype(np.float64))
            k = min(5, len(centres))
            spacing = tree.query(tree.data, k=[k], workers=-1)[0][:, 0] * np.sqrt(np.pi / 4) if k else np.zeros(0)
            width = torch.from_numpy(WIDTH * np.maximum(spacing, 1e-6)).to(centres)
            self._index = tree, centres, normals, 1 / (width * width)
        return self._index

    def _blend(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (n,) and gradient (n, 3); coordinates that are not finite count as 0."""
        tree, centres, normals, inverse = self._samples()
        k = min(NEIGHBOURS, len(centres))
        if not k:
            return torch.ones_like(points[:, 0]), torch.zeros_like(points)
        points = torch.where(torch.isfinite(points), points, 0.0)
        finite = points.detach().cpu()
        index = torch.from_numpy(np.asarray(tree.query(finite.numpy().astype(np.float64), k=range(1, k + 1), workers=-1)[1]))
        centres, normals, inverse = (x.to(points)[index] for x in (centres, normals, inverse))
        offset = points[:, None] - centres
        exponent = -0.5 * inverse * (offset * offset).sum(2)
        weight = torch.softmax(exponent, 1)
        plane = (normals * offset).sum(2)
        f = (weight * plane).sum(1)
        # ∂w/∂x = w (a − Σ w a) with a the gradient of the exponent
        a = -inverse[:, :, None] * offset
        slope = (weight[:, :, None] * normals).sum(1) + (weight * (plane - f[:, None]))[:, :, None].mul(a).sum(1)
        return f, slope

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (n,); +1 everywhere without surfels."""
        return self._blend(points)[0]

    def gradient(self, points: Tensor) -> Tensor:
        """Gradient (n, 3) of `value`."""
        return self._blend(points)[1]

    def sample_near_zero(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Projected centres and normals of opaque surfels drawn by their area."""
        with torch.no_grad():
            weight = self.surfels.scale.prod(1) * self.surfels.opacity()
            centres, normals = self.project_surfels(self.surfels), self.surfels.normal()
            weight = torch.where(torch.isfinite(centres).all(1) & torch.isfinite(weight), weight, 0.0).cpu()
            if not float(weight.sum()) > 0:
                return centres[:0], normals[:0]
            chosen = torch.multinomial(weight, min(count, int((weight > 0).sum())), generator=generator).to(centres.device)
            return centres[chosen], normals[chosen]

    def losses(self, step: TrainingStep, view: TrainView) -> Tensor | None:
        """Median, projection and silhouette loss."""
        w, s, out = self.loss, step.surfels, step.rendered
        total = None
        if step.late and w.median:
            total = w.median * losses.median_sharpness(s.sdf, s.gamma, s.transfer, self._widths(step))
        if step.late and w.projection:
            projection = w.projection * projection_loss(
                s.position, out.normal, s.sdf, out.visible, out.depth, out.alpha, view.R, view.t, view.pinhole
            )
            total = projection if total is None else total + projection
        if w.silhouette and view.mask is not None:
            outside = losses.silhouette_distance(self.project_surfels(s), self._mask_distance(view), view.R, view.t, view.pinhole)
            total = w.silhouette * outside if total is None else total + w.silhouette * outside
        return total

    def _mask_distance(self, view: TrainView) -> Tensor:
        """Distance (h, w) in pixels to the mask of a photo; 0 everywhere where the mask is empty."""
        key = view.name, view.pinhole.width
        if key not in self._distances:
            assert view.mask is not None
            outside = view.mask.cpu().numpy() < 128
            image = np.zeros(outside.shape, np.float32) if outside.all() else distance_to_zero(outside)
            self._distances[key] = torch.from_numpy(image).to(view.mask.device)
        return self._distances[key]

    def _widths(self, step: TrainingStep) -> tuple[float, float] | None:
        """Least and largest distance (unit frame) at which opacity is half, in this step; None where the unit frame is the unit."""
        if self.train is None or self.train.sharpness == "unit":
            return None
        spacing, final = typical_spacing(step.surfels), self.train.final_width
        widest = final if self.fine_tuning else max(self.train.band, final)
        return final * spacing, spacing * (final + (widest - final) * (1 - step.share))

    def mesh(self, lattice: BlockLattice, truncation: float) -> NDArray[np.float32]:
        """Implicit moving least squares with compact support; see `imls`."""
        samples = oriented_points(self.surfels)
        return imls_field(lattice, samples.points, samples.normals, truncation, samples.weights)
