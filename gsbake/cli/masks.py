"""`gsbake masks FOLDER`: the masks in use, to edit them and give them back with --masks."""

from __future__ import annotations

from pathlib import Path

from gsbake.capture.masks.editing import export_masks
from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_text
from gsbake.cli.replace import current_output
from gsbake.errors import UsageError
from gsbake.output_folder import require_outside_sources
from gsbake.pipeline.files import disk_error, path_error


def masks(options: Options, folder: Path, doubtful: bool) -> None:
    """Write the masks into `folder`, with `doubtful` only those that a person should look at. Raises UsageError before the first run."""
    session = options.session()
    require_outside_sources(folder, session.project)
    ingest, poses = (current_output(session, stage) for stage in ("ingest", "poses"))
    if ingest is None or poses is None:
        raise UsageError(f"'{session.out}' has no camera poses yet, from which masks are corrected; run `gsbake poses` first.")
    only = frozenset(poses.manifest["results"].get("doubtful_masks") or ()) if doubtful else None
    try:
        files = export_masks(ingest.folder, poses.folder, folder, only)
    except OSError as error:
        known = disk_error(error, folder) or path_error(error)
        if known is None:
            raise
        raise known from error
    if options.as_json:
        print_json({"folder": str(folder), "files": [str(path) for path in files]}, indent=None)
    elif not options.quiet:
        print_text(f"{len(files)} masks are in '{folder}'; edit them (white is the object), then run again with --masks '{folder}'")
