"""The weighted sum of all couplings that a profile asks for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from gsbake.surfels.couplings import attachment, extra_views, mutual, priors, pulling, regularity, rendering
from gsbake.surfels.couplings.coupled_field import CoupledField
from gsbake.surfels.couplings.inputs import CouplingInputs
from gsbake.surfels.field import TrainingStep
from gsbake.surfels.losses import terms
from gsbake.surfels.losses.projection import projection_loss
from gsbake.surfels.views import TrainView

#: Couplings by their setting in [coupling].
COUPLINGS: dict[str, Callable[[CouplingInputs], Tensor]] = {
    "surface": attachment.surface,
    "alignment": attachment.alignment,
    "opacity_target": attachment.opacity_target,
    "depth": mutual.depth,
    "normals": mutual.normals,
    "eikonal": regularity.eikonal,
    "smoothness": regularity.smoothness,
    "free_space": regularity.free_space,
    "silhouette": regularity.silhouette,
    "pulling": pulling.pulling,
    "colour": rendering.colour,
    "mask": rendering.mask,
    "extra_views": extra_views.extra_views,
    "prior_normals": priors.normals,
    "prior_depths": priors.depths,
}


def combined_losses(field: CoupledField, step: TrainingStep, view: TrainView, loss: Any, coupling: Any) -> Tensor | None:
    """Weighted sum of the couplings; None where none is on. Where the opacity follows from the field, the median and projection losses of
    the discretized SDF (section [loss]) act on f(μ) as on samples."""
    inputs = CouplingInputs(field, step, view)
    parts = []
    if field.settings.opacity == "field" and step.late:
        s, out = step.surfels, step.rendered
        f = inputs.at_surfels[0]
        if loss.median:
            parts.append(loss.median * terms.median_sharpness(f, s.gamma, s.transfer))
        if loss.projection:
            projected = projection_loss(s.position, out.normal, f, out.visible, out.depth, out.alpha, view.R, view.t, view.pinhole)
            parts.append(loss.projection * projected)
    for name, term in COUPLINGS.items():
        weight = getattr(coupling, name)
        if weight:
            parts.append(weight * term(inputs))
    total: Tensor | None = None
    for part in parts:
        total = part if total is None else total + part
    return total
