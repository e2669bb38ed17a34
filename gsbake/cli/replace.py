"""`gsbake replace STAGE FILE…`: replacement of a stage's output with the user's files."""

from __future__ import annotations

import tempfile
from pathlib import Path

from gsbake.api import Session
from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_text
from gsbake.cli.replace_mesh import is_lowpoly, write_lowpoly
from gsbake.errors import BadInputError, UsageError
from gsbake.own_files import SET_ASIDE
from gsbake.pipeline.files import disk_error, path_error
from gsbake.pipeline.replace import folder_files, replace_output, undo_replacement
from gsbake.pipeline.store import Artifact, Store

#: {(stage, suffix): files that a single file with this suffix replaces}: an edited mesh is both the low-poly and the dense mesh.
REPLACED_FILES = {("mesh", ".ply"): ("mesh.ply", "dense.ply")}


def replace(options: Options, stage: str, paths: list[Path], undo: bool) -> None:
    """Register the replacement, or undo it. Raises BadInputError for an output folder that cannot be written."""
    session = options.session()
    try:
        _replace(options, session, stage, paths, undo)
    except OSError as error:
        raise disk_error(error, session.out) or path_error(error) or _unreadable(error, session.out) from error


def _unreadable(error: OSError, out: Path) -> BadInputError:
    return BadInputError(f"The replacement in '{out}' failed: '{error.filename or out}' cannot be read or written ({error.strerror}).")


def _replace(options: Options, session: Session, stage: str, paths: list[Path], undo: bool) -> None:
    store = session.engine.store
    session.engine.registry.load(stage)
    if undo == bool(paths):
        raise UsageError("Give either the files that replace the output, or --undo.")
    if undo:
        if not options.dry_run:
            undo_replacement(store, stage)
        _print_result(options, store, {"stage": stage, "undone": True}, f"{stage}: its own output is used again")
        return
    base = current_output(session, stage)
    with tempfile.TemporaryDirectory(prefix="gsbake-replace-") as scratch:
        origin: dict[str, Path] = {}
        notes: tuple[str, ...] = ()
        if stage == "mesh" and any(map(is_lowpoly, paths)):
            needed = {"poses", "refine", "export"} & set(session.engine.registry.references)
            current = {name: current_output(session, name) for name in needed}
            files, origin, notes = write_lowpoly(paths, base, current, Path(scratch))
        else:
            files = _replacement_files(stage, paths, base)
        names, said = sorted(files), f" ({'; '.join(notes)})" if notes else ""
        extra = {"notes": list(notes)} if notes else {}
        if options.dry_run:
            text = f"{stage}: would replace {', '.join(names)}{said}"
            _print_result(options, store, {"stage": stage, "would_replace": names, **extra}, text)
            return
        artifact = replace_output(store, stage, files, base, origin)
    _print_result(
        options,
        store,
        {"stage": stage, "replaced": names, "folder": str(artifact.folder), **extra},
        f"{stage}: {', '.join(names)} replaced{said}; `gsbake run` continues from there",
    )


def current_output(session: Session, stage: str) -> Artifact | None:
    """The stage's present output: the replacement, else the cached artifact, else the newest one; None without any."""
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


def _replacement_files(stage: str, paths: list[Path], base: Artifact | None) -> dict[str, Path]:
    """{file in the artifact: file of the user}."""
    for path in paths:
        if not path.exists():
            raise BadInputError(f"'{path}' does not exist.")
    if len(paths) == 1 and paths[0].is_dir():
        return folder_files(paths[0])
    files: dict[str, Path] = {}
    known = set(base.files) if base is not None else set()
    for path in paths:
        replaced = REPLACED_FILES.get((stage, path.suffix.lower()), ())
        if len(paths) == 1 and replaced and path.name not in set(replaced[1:]):
            _check_ply(path)
            files.update(dict.fromkeys(replaced, path))
        elif path.name in known or path.name in replaced:
            files[path.name] = path
        elif known:
            raise UsageError(f"Stage '{stage}' has no file '{path.name}' in its output; it has {', '.join(sorted(known)[:8])}.")
        else:
            raise UsageError(
                f"Stage '{stage}' has not run yet, so it is unknown which file '{path.name}' replaces: run it first, or give a folder."
            )
    return files


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        if file.read(3) != b"ply":
            raise BadInputError(f"'{path}' is not a PLY file; export the mesh as PLY.")


def _print_result(options: Options, store: Store, document: dict[str, object], text: str) -> None:
    moved = store.take_moved()
    if options.as_json:
        print_json({**document, **({"set_aside": [str(path) for path in moved]} if moved else {})}, indent=None)
    elif not options.quiet:
        aside = store.out / SET_ASIDE / str(document["stage"])
        print_text(text + (f"; the files that were there before are in '{aside}'" if moved else ""))
