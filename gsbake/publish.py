"""Publication of a run's results in its output folder: asset.glb, cameras.json, light.hdr, report.html, and the files of targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from gsbake.pipeline.digest import DigestCache
from gsbake.pipeline.files import copy_atomic
from gsbake.pipeline.project import Project
from gsbake.pipeline.store import Artifact

#: {stage: files that are copied to the output folder}.
RESULTS = {"export": ("asset.glb", "cameras.json", "light.hdr"), "report": ("report.html",)}
#: Stage whose files are all results, but for these suffixes and names.
TARGETS, INTERNAL = "targets", (".audit.json", "targets.json")


def publish_results(
    out: Path, artifacts: Mapping[str, Artifact], project: Project, digests: DigestCache
) -> tuple[dict[str, Path], Project]:
    """Copy the results of the artifacts; returns {file: path in `out`} and the project with the digests of the published files.

    Copies, not links: saving the asset in another program must not change the artifact. A file that this run no longer has (light.hdr
    without materials) is deleted if it is unchanged since an earlier run published it.
    """
    placed: dict[str, Path] = {}
    published = dict(project.published)
    for stage, names in _results(artifacts, published).items():
        artifact = artifacts.get(stage)
        if artifact is None:
            continue
        for name in names:
            path = out / name
            there = digests.file(path) if path.is_file() else None
            if name in artifact.files:
                if there != artifact.files[name]:
                    path.parent.mkdir(exist_ok=True)
                    copy_atomic(artifact.folder / name, path)
                published[name] = artifact.files[name]
                placed[name] = path
            elif there is not None and there == published.pop(name, None):
                path.unlink()
    return placed, replace(project, published=published)


def _results(artifacts: Mapping[str, Artifact], published: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """{stage: files that it has, or had when it was published before}."""
    found = artifacts.get(TARGETS)
    if found is None:
        return dict(RESULTS)
    now = {name for name in found.files if not name.endswith(INTERNAL)}
    fixed = {name for names in RESULTS.values() for name in names}
    return {**RESULTS, TARGETS: tuple(sorted(now | (set(published) - fixed)))}
