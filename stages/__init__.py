"""The stages of a bake, in order; each module defines `STAGE` and is imported only when it is asked for."""

from __future__ import annotations

from gsbake.pipeline.registry import Registry

#: Stage names in the order they run, and where each is declared.
ORDER = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export", "report")
REGISTRY = Registry({name: f"gsbake.stages.{name}:STAGE" for name in ORDER})
