"""From the options of a call and what the output folder remembers to an engine that is ready to run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from gsbake.capture.sources import PHOTO_FOLDERS, discover, list_photos
from gsbake.cli.options import Options
from gsbake.config.load import DEFAULT, LoadedProfile, load_profile
from gsbake.errors import UsageError
from gsbake.pipeline.digest import list_files
from gsbake.pipeline.engine import Engine, Observer
from gsbake.pipeline.machine import default_threads, resolve_device
from gsbake.pipeline.plan import Request
from gsbake.pipeline.project import Project
from gsbake.stages import REGISTRY


@dataclass(frozen=True)
class Session:
    """An engine, and the project and profile it was made from."""

    engine: Engine
    project: Project
    profile: LoadedProfile
    out: Path


def open_session(options: Options, observer: Observer | None = None) -> Session:
    """Merge the options with the output folder's memory; nothing is written.

    PHOTOS starts the memory anew; without it the remembered photos, profile and `--set`s hold, and given ones are added.
    """
    out = options.out or _default_out(options.photos)
    stored = Project.load(out)
    if options.photos is not None:
        project = Project(published=stored.published if stored else {})
        found = discover(options.photos, options.masks, options.poses)
        project = replace(project, photos=_text(found.photos), masks=_text(found.masks), poses=_text(found.poses))
    elif stored is None or stored.photos is None:
        raise UsageError(f"'{out}' holds no run yet: give the folder of photos the first time.")
    else:
        project = stored
        if options.masks is not None or options.poses is not None:
            found = discover(Path(stored.photos), options.masks or _path(stored.masks), options.poses or _path(stored.poses))
            project = replace(project, masks=_text(found.masks), poses=_text(found.poses))
    overrides = [*project.overrides, *options.overrides]
    if options.invert_masks:
        overrides.append("ingest.invert_masks=true")
    last = {text.partition("=")[0].strip(): text for text in overrides}
    name = options.profile or project.profile or DEFAULT
    profile = load_profile(name, list(last.values()))
    if Path(name).is_file():
        name = str(Path(name).resolve())
    project = replace(project, profile=name, overrides=tuple(last.values()), seed=project.seed if options.seed is None else options.seed)
    sources = project.sources()
    request = Request(
        out=out,
        sources=sources,
        profile=profile.profile,
        seed=project.seed,
        device=resolve_device(options.device),
        threads=options.threads or default_threads(),
        source_names=_source_names(sources),
    )
    return Session(Engine(REGISTRY, request, observer), project, profile, out)


def _source_names(sources: dict[str, Path]) -> dict[str, list[str]]:
    """The files that count in the folders of photos and masks."""
    names = {"photos": [path.relative_to(sources["photos"]).as_posix() for path in list_photos(sources["photos"])]}
    if "masks" in sources and sources["masks"].is_dir():
        names["masks"] = list_files(sources["masks"])
    return names


def _default_out(photos: Path | None) -> Path:
    """out/<name>, or the only run in out/."""
    if photos is not None:
        folder = photos.resolve()
        return Path("out") / (folder.parent.name if folder.name in PHOTO_FOLDERS else folder.name)
    runs = sorted(path.parent for path in Path("out").glob("*/project.json"))
    if len(runs) == 1:
        return runs[0]
    if not runs:
        raise UsageError("There is no run in ./out yet: give the folder of photos, or say with --out which run is meant.")
    raise UsageError(f"There are {len(runs)} runs in ./out ({', '.join(p.name for p in runs[:5])}…): say with --out which one is meant.")


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path.resolve())


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)
