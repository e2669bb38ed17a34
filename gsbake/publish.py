"""Publishing the results of a run in its output folder: asset.glb, cameras.json, light.hdr and report.html."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from gsbake.pipeline.digest import DigestCache
from gsbake.pipeline.files import copy_atomic
from gsbake.pipeline.project import Project
from gsbake.pipeline.store import Artifact

#: Which files of which stage are put into OUT.
RESULTS = {"export": ("asset.glb", "cameras.json", "light.hdr"), "report": ("report.html",)}


def publish_results(
    out: Path, artifacts: Mapping[str, Artifact], project: Project, digests: DigestCache
) -> tuple[dict[str, Path], Project]:
    """Copy the results that the artifacts hold; returns {file: path in OUT} and the project with what was published.

    Copies, not links: an asset opened and saved in another program must not change the artifact. A result that this run no longer has
    (the light, without materials) is deleted if it is still what an earlier run put there.
    """
    placed: dict[str, Path] = {}
    published = dict(project.published)
    for stage, names in RESULTS.items():
        artifact = artifacts.get(stage)
        if artifact is None:
            continue
        for name in names:
            target = out / name
            there = digests.file(target) if target.is_file() else None
            if name in artifact.files:
                if there != artifact.files[name]:
                    copy_atomic(artifact.folder / name, target)
                published[name] = artifact.files[name]
                placed[name] = target
            elif there is not None and there == published.pop(name, None):
                target.unlink()
    return placed, replace(project, published=published)
