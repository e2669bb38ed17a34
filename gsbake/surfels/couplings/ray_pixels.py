"""Which pixels rays are drawn from: inside the mask, evenly or in proportion to the photo's edges, and around it.

GaussianRoom (Xiang et al. 2024) draws more rays where the photo has edges. The tables of a photo are made once.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from gsbake.surfels.views import TrainView

#: Share of the rays inside the mask; the others are drawn around it.
INSIDE_SHARE = 0.8
#: Pixels around the mask in which rays outside are drawn.
BORDER = 12


@dataclass(frozen=True)
class PixelTable:
    """Flat indices of the pixels `inside` (a,) and `around` (b,) the mask, and the cumulative weights (a,) of those inside (None: even)."""

    inside: Tensor
    around: Tensor
    cumulative: Tensor | None

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`count` random flat indices; all inside, or all around, where there are none of the others."""
        inside = round(INSIDE_SHARE * count) if len(self.around) else count
        parts = []
        if len(self.inside):
            if self.cumulative is None:
                parts.append(self.inside[torch.randint(len(self.inside), (inside,), generator=generator)])
            else:
                at = torch.searchsorted(self.cumulative, torch.rand(inside, generator=generator) * self.cumulative[-1])
                parts.append(self.inside[at.clamp_max(len(self.inside) - 1)])
        if len(self.around) and count > inside:
            parts.append(self.around[torch.randint(len(self.around), (count - inside,), generator=generator)])
        return torch.cat(parts) if parts else self.inside


def pixel_table(view: TrainView, cover: Tensor, edges: float) -> PixelTable:
    """The table of a photo whose object covers `cover` (h, w) in 0..1; `edges` is the share of the rays drawn in proportion to edges."""
    covered = (cover > 0.5).cpu().numpy()
    box = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    around = (cv2.dilate(covered.astype(np.uint8), box) > 0) & (cover.cpu().numpy() < 0.1)
    inside = torch.from_numpy(np.flatnonzero(covered))
    cumulative = None
    if edges and len(inside):
        grey = view.colour().mean(0).cpu().numpy()
        edge = torch.from_numpy(np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)).ravel())[inside]
        weight = 1 - edges + edges * edge / edge.mean().clamp_min(1e-6)
        cumulative = weight.double().cumsum(0).float()
    if not len(inside) and not around.any():
        inside = torch.arange(cover.numel())
    return PixelTable(inside, torch.from_numpy(np.flatnonzero(around)), cumulative)
