"""Shares of the parts in a stage's seconds, for runs that no earlier run tells of.

Measured in one run of `relight` on 48 photos of 400 × 400 pixels with masks and given poses, on two cores with other work, in which kernels
were compiled too, and bake without the material fit with `smoke` on the built-in capture: good enough until a run has been measured here.
Shares below a hundredth are left out. The rest of a stage is the start of its process and what no part times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: {stage, bake with its `bake.materials`: {part: share}}, in running order.
PARTS: Mapping[str, Mapping[str, float]] = {
    "ingest": {"photos": 0.65},
    "poses": {"features": 0.25, "matching": 0.15, "verification": 0.05, "triangulation": 0.05, "normalisation": 0.34, "masks": 0.01},
    "stereo": {
        "hull": 0.12, "rigidity": 0.01, "matching": 0.52, "consistency": 0.08, "mirror images": 0.07, "fusion": 0.04, "carving": 0.08,
    },
    "train": {"initialisation": 0.02, "training": 0.89},
    "refine": {"prune and densify": 0.24, "load photos": 0.01, "training": 0.56},
    "mesh": {
        "depth": 0.05, "survey": 0.03, "filling": 0.03, "fusion": 0.02, "marching": 0.02, "clean": 0.05, "shape": 0.50,
        "denoising": 0.04, "untangling": 0.06, "decimate": 0.15,
    },
    "bake fit": {
        "atlas": 0.02, "texels": 0.01, "occlusion": 0.06, "projection": 0.09, "light transport": 0.14, "trial fits of moving lights": 0.11,
        "trial fits": 0.19, "material fit, coarse level": 0.19, "trials of metal and dielectric": 0.10, "remaining shading": 0.02,
        "material fit, fine level": 0.03, "full texture": 0.03,
    },
    "export": {"images": 0.47, "write": 0.24, "previews": 0.14, "audit": 0.07},
    "report": {"open": 0.04, "compare": 0.29, "relight": 0.36, "page": 0.04},
    "bake none": {"atlas": 0.09, "normals": 0.02, "occlusion": 0.02, "projection": 0.38},
}  # fmt: skip


def usual_parts(stage: str, settings: Mapping[str, Any]) -> Mapping[str, float]:
    """Shares of a stage's parts; empty for a stage whose parts are not known."""
    return PARTS.get(f"{stage} {settings.get('bake.materials')}" if stage == "bake" else stage, {})
