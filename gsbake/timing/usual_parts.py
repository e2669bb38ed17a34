"""Shares of the parts in a stage's seconds, for runs that no earlier run tells of.

Measured with `relight` on two captures of 40 and 48 small photos, one with given poses, and bake without the material fit with `smoke` on
the built-in capture; what is below a hundredth is left out. The rest of a stage is the start of its process and what no part times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: {stage, bake with its `bake.materials`: {part: share}}, in running order.
PARTS: Mapping[str, Mapping[str, float]] = {
    "ingest": {"photos": 0.62},
    "poses": {"features": 0.35, "matching": 0.12, "verification": 0.04, "triangulation": 0.03, "normalisation": 0.30, "masks": 0.02},
    "stereo": {"hull": 0.07, "matching": 0.57, "consistency": 0.10, "mirror images": 0.08, "fusion": 0.03, "carving": 0.08},
    "train": {"initialisation": 0.02, "training": 0.88},
    "refine": {"prune and densify": 0.19, "training": 0.65},
    "mesh": {
        "depth": 0.07, "survey": 0.04, "filling": 0.04, "fusion": 0.02, "marching": 0.03, "clean": 0.04, "silhouettes": 0.19,
        "denoising": 0.04, "photos": 0.35, "decimate": 0.14,
    },
    "bake fit": {
        "atlas": 0.03, "texels": 0.02, "occlusion": 0.06, "projection": 0.06, "light transport": 0.07, "trial fits of moving lights": 0.06,
        "trial fits": 0.17, "material fit, coarse level": 0.19, "trials of metal and dielectric": 0.14, "remaining shading": 0.05,
        "material fit, fine level": 0.14,
    },
    "export": {"images": 0.43, "write": 0.23, "previews": 0.15, "audit": 0.06},
    "report": {"open": 0.06, "compare": 0.28, "relight": 0.35, "page": 0.04},
    "bake none": {"atlas": 0.09, "normals": 0.02, "occlusion": 0.02, "projection": 0.38},
}  # fmt: skip


def usual_parts(stage: str, settings: Mapping[str, Any]) -> Mapping[str, float]:
    """Shares of a stage's parts; empty for a stage whose parts are not known."""
    return PARTS.get(f"{stage} {settings.get('bake.materials')}" if stage == "bake" else stage, {})
