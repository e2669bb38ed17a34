"""Registry of the stages; each module defines `STAGE` and is imported on demand."""

from __future__ import annotations

from gsbake.pipeline.registry import Registry

#: Stage names in running order.
ORDER = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export", "report", "targets")
REGISTRY = Registry({name: f"gsbake.stages.{name}:STAGE" for name in ORDER})
