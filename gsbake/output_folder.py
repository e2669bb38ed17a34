"""Whether gsbake may write into an output folder: it is new, empty or its own, apart from the photos, and not of other photos.

Its mark is `project.json`. Without it, it is still gsbake's own where nothing else lies in it than what gsbake makes there, or the built-in
capture.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

from gsbake.capture.sources import SKIPPED_FOLDERS, reads_subfolders
from gsbake.errors import UsageError
from gsbake.own_files import SET_ASIDE, entries, require_own_folder
from gsbake.pipeline.digest import is_digest_cache
from gsbake.pipeline.project import PROJECT, Project
from gsbake.pipeline.uses import FOLDER as RUNNING
from gsbake.publish import is_result
from gsbake.synth.folder import is_capture

EVENTS, DIGESTS, LIVE = "events.jsonl", "digests.json", "live.json"
#: What gsbake makes in an output folder beside the results; the last name is that of earlier versions for files that were set aside.
_MADE = frozenset({PROJECT, EVENTS, DIGESTS, LIVE, "stages", "logs", "errors", RUNNING, SET_ASIDE, "unexpected"})


def check_output_folder(out: Path, stored: Project | None, project: Project) -> None:
    """Refuse an output folder that is not gsbake's own, or lies inside the photos or masks, or holds the photos among its stored outputs.

    `stored` is the project of the folder, None without one; `project` that of the run. Raises UsageError.
    """
    require_own_folder(out, (stored is not None and stored.photos is not None) or _has_own_layout(out), "the output")
    require_outside_sources(out, project)
    photos, stages = project.sources().get("photos"), out.resolve() / "stages"
    if photos is not None and stages in (photos.resolve(), *photos.resolve().parents):
        raise UsageError(f"The photos '{photos}' lie among the stored outputs in '{out}', which may be deleted; copy them elsewhere.")


def require_outside_sources(folder: Path, project: Project) -> None:
    """Raise UsageError for a folder to write into whose files would be read as photos or masks of the project."""
    place = folder.resolve()
    if place.is_file():
        return  # no folder can be made there
    for kind, source in project.sources().items():
        above = source.resolve()
        read = reads_subfolders(above) if kind == "photos" else kind == "masks" and above.is_dir()
        if read and (place == above or above in place.parents):
            if kind == "photos" and SKIPPED_FOLDERS.intersection(place.relative_to(above).parts):
                continue
            raise UsageError(f"'{folder}' lies inside the {kind}, '{source}', and its files would be read as such; name another.")


def check_same_photos(out: Path, stored: Project | None, project: Project) -> UsageError | None:
    """The refusal of photos that are not those of the output folder's run by their path; None where they are, or lie inside the folder."""
    if stored is None or stored.photos is None or project.photos is None or stored.photos == project.photos:
        return None
    if out.resolve() in Path(project.photos).parents:
        return None  # photos that moved together with their output folder, as the demo's do
    with suppress(OSError):
        if os.path.samefile(stored.photos, project.photos):
            return None
    return UsageError(
        f"'{out}' holds the run of other photos, '{stored.photos}', not of '{project.photos}'; name another folder with --out, or say "
        "--moved if the photos merely moved."
    )


def _has_own_layout(out: Path) -> bool:
    found = [name for name in entries(out) if not (name == DIGESTS and is_digest_cache(out / name)) and not is_capture(out / name)]
    return not found or (_is_event_log(out / EVENTS) and all(name in _MADE or _is_published_name(name, out) for name in found))


def _is_published_name(name: str, out: Path) -> bool:
    inside = entries(out / name)
    return all(is_result(f"{name}/{file}") for file in inside) if inside else is_result(name)


def _is_event_log(path: Path) -> bool:
    """Whether a file begins with an event that gsbake wrote."""
    with suppress(OSError, ValueError, RecursionError), path.open("rb") as file:
        event = json.loads(file.readline(1 << 16))
        return isinstance(event, dict) and {"time", "run", "event"} <= event.keys()
    return False
