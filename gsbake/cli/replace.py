"""`gsbake replace STAGE FILE…`: a person's own file in place of a stage's output."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from gsbake.cli.options import Options
from gsbake.errors import BadInputError, UsageError
from gsbake.pipeline.replace import folder_files, replace_output, undo_replacement
from gsbake.pipeline.store import Artifact

#: A single file with this ending stands for these files of the stage: an edited mesh is both the detailed and the reduced one.
STANDS_FOR = {("mesh", ".ply"): ("mesh.ply", "dense.ply")}


def replace(options: Options, stage: str, paths: list[Path], undo: bool) -> None:
    """Register the files, or take the registration back."""
    session = options.session()
    store = session.engine.store
    session.engine.registry.load(stage)
    if undo == bool(paths):
        raise UsageError("Give either the files that replace the output, or --undo.")
    if undo:
        if not options.dry_run:
            undo_replacement(store, stage)
        _say(options, {"stage": stage, "undone": True}, f"{stage}: its own output counts again")
        return
    base = _current(options, stage)
    files = _named(stage, paths, base)
    if options.dry_run:
        _say(options, {"stage": stage, "would_replace": sorted(files)}, f"{stage}: would replace {', '.join(sorted(files))}")
        return
    artifact = replace_output(store, stage, files, base)
    _say(
        options,
        {"stage": stage, "replaced": sorted(files), "folder": str(artifact.folder)},
        f"{stage}: {', '.join(sorted(files))} put in place by hand; `gsbake run` goes on from there",
    )


def _current(options: Options, stage: str) -> Artifact | None:
    """The stage's output as things stand: by hand, else cached, else the newest there is."""
    session = options.session()
    replacement = session.engine.store.replacement(stage)
    if replacement is not None:
        return replacement.artifact
    state = next(s for s in session.engine.plan(stage) if s.name == stage)
    if state.artifact is not None:
        return state.artifact
    newest = session.engine.store.manifests(stage)
    if not newest:
        return None
    folder, manifest = newest[0]
    return Artifact(folder, {name: entry["digest"] for name, entry in manifest["files"].items()}, manifest)


def _named(stage: str, paths: list[Path], base: Artifact | None) -> dict[str, Path]:
    """{name in the artifact: the person's file}."""
    for path in paths:
        if not path.exists():
            raise BadInputError(f"'{path}' does not exist.")
    if len(paths) == 1 and paths[0].is_dir():
        return folder_files(paths[0])
    files: dict[str, Path] = {}
    known = set(base.files) if base is not None else set()
    for path in paths:
        targets = STANDS_FOR.get((stage, path.suffix.lower()), ())
        if len(paths) == 1 and targets and path.name not in set(targets[1:]):
            _check_ply(path)
            files.update(dict.fromkeys(targets, path))
        elif path.name in known or path.name in targets:
            files[path.name] = path
        elif known:
            raise UsageError(f"Stage '{stage}' has no file '{path.name}' in its output; it has {', '.join(sorted(known)[:8])}.")
        else:
            raise UsageError(
                f"Stage '{stage}' has not run yet, so nothing tells what '{path.name}' replaces: run it first, or give a folder."
            )
    return files


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        if file.read(3) != b"ply":
            raise BadInputError(f"'{path}' is not a PLY file, whatever its name says; export the mesh as PLY.")


def _say(options: Options, document: dict[str, object], text: str) -> None:
    if options.as_json:
        typer.echo(json.dumps(document, ensure_ascii=False))
    elif not options.quiet:
        typer.echo(text)
