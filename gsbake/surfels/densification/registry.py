"""Densification and pruning policies by the names that profiles use, and the choice that "auto" makes."""

from __future__ import annotations

from gsbake.surfels.densification import disabled, gaussianroom, gradient, gs_ror2, gsdf, sdf_guided, visibility
from gsbake.surfels.densification.policy import DensificationPolicy, PruningPolicy

#: Policies of `train.densify`, which also takes "auto".
DENSIFICATION: dict[str, DensificationPolicy] = {
    "gradient": gradient.score,
    "sdf": sdf_guided.score,
    "gsdf": gsdf.score,
    "gaussianroom": gaussianroom.score,
    "none": disabled.score,
}
#: Policies of `train.prune` and `refine.prune`.
PRUNING: dict[str, PruningPolicy] = {
    "visibility": visibility.prune,
    "sdf": sdf_guided.prune,
    "gsdf": gsdf.prune,
    "gaussianroom": gaussianroom.prune,
    "gs-ror2": gs_ror2.prune,
}


def choose_densification(setting: str, initialisation: str) -> tuple[str, str]:
    """The name in `DENSIFICATION` for the setting `train.densify`, given the initialisation ("stereo", "hull", …), and the evidence."""
    if setting != "auto":
        return setting, "set by the profile"
    if initialisation == "stereo":
        return "none", "stereo points are evenly spread; more surfels cost more than they gain"
    return "gradient", f"initialisation from {initialisation} is coarse and needs more surfels where it does not fit the photos"
