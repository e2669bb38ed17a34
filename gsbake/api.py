"""Python API: `gsbake.run("photos", profile="relight")` brings an output folder up to date, as `gsbake run` does.

The output folder stores photos, profile and settings; later calls may give the folder alone. Each step is a function of plain paths too:
`gsbake.capture.ingest.ingest`, `gsbake.mvs.stereo.run_stereo`, `gsbake.meshing.extract.extract_mesh` and so on, one per stage.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsbake.capture.masks.weights import resolve_network
from gsbake.capture.sources import PHOTO_FOLDERS, discover, list_masks, require_photo, source_files
from gsbake.config.load import DEFAULT, LoadedProfile, fields, load_profile
from gsbake.config.renamed import present_override
from gsbake.config.schema import Profile
from gsbake.config.targets import parse_target, require_packages
from gsbake.config.white import WhitePatch, parse_white
from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.meshing.decimator_choice import resolve_decimator
from gsbake.output_folder import check_output_folder, check_same_photos
from gsbake.pipeline.engine import Engine, Observer, artifacts_by_stage
from gsbake.pipeline.files import disk_error, ensure_output_folder
from gsbake.pipeline.machine import default_threads, resolve_device
from gsbake.pipeline.plan import Request, StageState
from gsbake.pipeline.project import Project
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.shared_store import open_shared_store
from gsbake.pipeline.store import Store
from gsbake.pipeline.store_url import VARIABLE as STORE_VARIABLE
from gsbake.publish import RESULTS, publish_results
from gsbake.stages import REGISTRY
from gsbake.system.names import portable_name
from gsbake.text import number

#: Stage that runs only where targets are asked for.
TARGETS = "targets"
#: Largest seed that all libraries accept (32-bit signed integer).
MAX_SEED = 2**31 - 1
#: Most threads: more than any machine has cores, few enough for every library's pool.
MAX_THREADS = 512


@dataclass(frozen=True)
class RunOptions:
    """Options of a run, those of `run`; None stands for the value stored in the output folder, else the default.

    `overrides` are settings as "section.key=value", added to the stored ones; `threads` = 0 uses the physical cores.
    `store` names a shared store, a folder or URL, which is not stored; None takes the variable GSBAKE_STORE. `overwrite` lets results take
    the place of files that were edited, which are set aside; `moved` says that the photos of an earlier run lie at another path now; stored
    settings that `unset` names are forgotten.
    """

    photos: Path | None = None
    out: Path | None = None
    profile: str | None = None
    overrides: Sequence[str] = ()
    masks: Path | None = None
    poses: Path | None = None
    device: str = "auto"
    threads: int = 0
    seed: int | None = None
    store: str | None = None
    overwrite: bool = False
    moved: bool = False
    unset: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Session:
    """A run ready to start: the engine, the stored options (`project`), the profile, the output folder and the shared store.

    `engine.plan()` says what each stage would do; nothing is computed or written before `run`.
    """

    engine: Engine
    project: Project
    profile: LoadedProfile
    out: Path
    store: str | None = None  # shared store, a folder or URL
    overwrite: bool = False  # files of the user's in the place of results are set aside

    def run(self, until: str | None = None) -> Result:
        """Bring the stages up to `until` (None: all) up to date and publish the results in the output folder, those of finished stages
        also where a later one fails.

        Raises:
            UsageError: There is no such stage, or no target files are set.
            BadInputError: A stage cannot use the data, or the output folder cannot be written.
            InterruptedRun: Stopped on request or by a fault that may pass.
        """
        if until == TARGETS and TARGETS not in self.engine.registry.names:
            raise UsageError("No target is set: name them, as in --target web,ar:usdz (settings: targets.files).")
        self._require_named_photos()
        self.engine.shared = open_shared_store(self.store)
        try:
            with self.engine.uses:  # until the results are copied
                states = self.engine.run(until, on_accepted=lambda: self.project.save(self.out))
                files, notes = self._publish(states)
        except GsbakeError:
            with suppress(OSError, GsbakeError):  # the first error is the one to report
                self._publish(self.engine.finished)
            raise
        except OSError as error:
            raise disk_error(error, self.out) or BadInputError(
                f"The output folder '{self.out}' cannot be written ({error.strerror}); choose another with --out."
            ) from error
        return Result(self.out, files, tuple(states), notes)

    def store_settings(self) -> None:
        """Store the options in the output folder, for its next run. Raises BadInputError where it cannot be written, or for a
        photo that a setting names and that is none."""
        self._require_named_photos()
        try:
            ensure_output_folder(self.out)
            self.project.save(self.out)
        except OSError as error:
            raise disk_error(error, self.out) or BadInputError(
                f"The output folder '{self.out}' cannot be written ({error.strerror}); choose another with --out."
            ) from error

    def _require_named_photos(self) -> None:
        """Refuse names of photos that are none, which else a late stage would find."""
        profile = self.profile.profile
        patches = map(parse_white, profile.bake.white)
        named = [("bake.white", patch.position.photo) for patch in patches if isinstance(patch, WhitePatch)]
        named += [("export.front", profile.export.front)] if profile.export.front else []
        if self.project.photos is not None:
            for setting, photo in named:
                if photo in profile.ingest.leave_out:
                    raise BadInputError(f"{setting} names the photo '{photo}', which ingest.leave_out leaves out; name another.")
                require_photo(Path(self.project.photos), photo, setting)

    def _publish(self, states: Sequence[StageState]) -> tuple[dict[str, Path], tuple[str, ...]]:
        """Copy the results of these stages to the output folder; returns {file: path} and what needs a word."""
        artifacts = artifacts_by_stage(states)
        if not RESULTS.keys() & artifacts.keys():
            return {}, ()
        store = self.engine.store
        done = publish_results(self.out, artifacts, self.project, store, overwrite=self.overwrite)
        done.project.save(self.out)
        store.digests.save()
        for stage, text in done.notes:
            self.engine.warn(stage, text)
        return done.files, tuple(text for _, text in done.notes)


@dataclass(frozen=True)
class Result:
    """A finished run: output folder, published `files` by name ("asset.glb", …), the state of every stage, and sentences on files that lie
    elsewhere than usual, because others are in their places."""

    out: Path
    files: Mapping[str, Path]
    stages: tuple[StageState, ...]
    notes: tuple[str, ...] = ()

    def results(self, stage: str) -> Mapping[str, Any]:
        """Figures that a stage reported, for example `results("poses")["registered"]`.

        Raises:
            KeyError: The stage was not part of the run.
        """
        for state in self.stages:
            if state.name == stage and state.artifact is not None:
                found: Mapping[str, Any] = state.artifact.manifest.get("results", {})
                return found
        raise KeyError(stage)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of all stages, cached ones included."""
        manifests = [state.artifact.manifest for state in self.stages if state.artifact is not None]
        return tuple(text for manifest in manifests for text in manifest.get("warnings", ()))


def run(
    photos: str | Path | None = None,
    *,
    out: str | Path | None = None,
    profile: str | None = None,
    settings: Mapping[str, Any] | None = None,
    masks: str | Path | None = None,
    poses: str | Path | None = None,
    until: str | None = None,
    device: str = "auto",
    threads: int = 0,
    seed: int | None = None,
    store: str | Path | None = None,
    overwrite: bool = False,
    moved: bool = False,
    observer: Observer | None = None,
) -> Result:
    """Bake an asset from a folder of photos, or bring an earlier run in `out` up to date.

    Stages whose inputs, settings and code did not change are taken from `out`, and finished ones stay there when a later one fails.

    Args:
        photos: Folder of photos, a video, or a capture folder with images/, masks/ and poses; needed in the first call only.
        out: Output folder; default `out/<name of photos>`.
        profile: Name of a profile, or path of a TOML file; default "relight".
        settings: {"section.key": value} that override the profile, for example {"mesh.faces": 10000}.
        masks: Masks outside the capture folder.
        poses: Known poses outside the capture folder.
        until: Last stage to run, for example "mesh"; None runs all.
        device: "auto", "cpu" or "cuda".
        threads: Number of threads, at most 512; 0 uses the physical cores.
        seed: Seed of all random numbers, 0 to 2**31 − 1; default 0.
        store: Shared store, a folder or URL (file, s3, sftp); default: the environment variable GSBAKE_STORE, else none.
        overwrite: Files of yours in the place of results, such as an edited `asset.glb`, are moved to `out/set-aside/`; without it they
            stay and the new ones are published beside them (`asset.new.glb`).
        moved: The photos of the run in `out` lie at another path now; without it, other photos than its own are refused.
        observer: Receives progress, decisions and warnings.

    Returns:
        The published files and the state of every stage.

    Raises:
        UsageError: Arguments, settings or profile are wrong, or `out` is not gsbake's own or holds the run of other photos.
        BadInputError: The photos cannot be used; trying again will not help.
        InterruptedRun: Stopped on request or by a fault that may pass; the same call resumes.
    """
    overrides = [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in (settings or {}).items()]
    options = RunOptions(
        _path(photos), _path(out), profile, overrides, _path(masks), _path(poses), device, threads, seed, _store(store), overwrite, moved
    )
    return open_session(options, observer).run(until)


def open_session(options: RunOptions, observer: Observer | None = None, registry: Registry | None = None) -> Session:
    """Merge the options with those stored in the output folder; nothing is written.

    With `photos` the stored options are discarded; without it they hold and the given ones are added.

    Args:
        options: What to run on, where, and how.
        observer: Receives the events of the run.
        registry: Other stages than gsbake's own.

    Raises:
        UsageError: Photos are neither given nor stored, a profile or setting is wrong, a seed or number of threads is out of range, or the
            output folder is not gsbake's own, lies inside the photos or holds the run of other photos.
        BadInputError: The photos' folder has none.
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
    check_output_folder(out, stored, project)
    unknown = sorted(options.unset - fields().keys())
    if unknown:
        raise UsageError(f"There is no setting '{unknown[0]}' to unset; `gsbake profiles {DEFAULT}` lists them.")
    last = {text.partition("=")[0].strip(): text for text in project.overrides}
    last = {key: text for key, text in last.items() if key not in options.unset}
    last |= {text.partition("=")[0].strip(): text for text in options.overrides}
    name = next(name for name in (options.profile, project.profile, DEFAULT) if name is not None)
    profile = load_profile(name, list(last.values()))
    if options.masks is not None and profile.profile.ingest.masks == "ignore":
        raise UsageError("Masks are given, but ingest.masks is ignore, which uses none; set it to auto.")
    if Path(name).is_file():
        name = str(Path(name).resolve())
    seed = project.seed if options.seed is None else options.seed
    if not 0 <= seed <= MAX_SEED:
        raise UsageError(f"The seed must be a whole number from 0 to {number(MAX_SEED)}, not {seed}.")
    if not 0 <= options.threads <= MAX_THREADS:
        raise UsageError(f"The number of threads must be from 0 (the physical cores) to {MAX_THREADS}, not {options.threads}.")
    project = replace(project, profile=name, overrides=tuple(map(present_override, last.values())), seed=seed)
    sources = project.sources() | _priors(project, profile.profile)
    request = Request(
        out=out,
        sources=sources,
        profile=_with_resolved_tools(profile.profile),
        seed=project.seed,
        device=resolve_device(options.device),
        threads=options.threads or default_threads(),
        source_names=_source_names(sources),
    )
    store = options.store or os.environ.get(STORE_VARIABLE) or None
    stages = registry or REGISTRY
    wanted = profile.profile.targets
    require_packages(parse_target(text) for text in wanted.files)
    if not wanted.files:  # no run shall list a stage that has nothing to do
        stages = stages.without(TARGETS)
    engine = Engine(stages, request, observer)
    other = None if options.moved else check_same_photos(out, stored, project)
    if other is not None and not (stored and stored.photos and _merely_moved(engine, Path(stored.photos))):
        raise other
    return Session(engine, project, profile, out, store, options.overwrite)


def _merely_moved(engine: Engine, before: Path) -> bool:
    """Whether the photos of an earlier run are gone from where they were and the given ones are the same."""
    return not before.exists() and engine.planner.plan(engine.registry.up_to(None)[:1])[0].status == "cached"


def open_store(out: Path | None) -> tuple[Store, tuple[str, ...]]:
    """Artifacts of the run in `out` (None: the only run in ./out), and the names of the stages.

    Raises:
        UsageError: `out` holds no run, or there are several in ./out.
    """
    out = out or _default_out(None)
    if not (out / "stages").is_dir():
        raise UsageError(f"'{out}' holds no run; name its folder with --out.")
    return Store(out), tuple(REGISTRY.names)


def _with_resolved_tools(profile: Profile) -> Profile:
    """The profile with what decimates and what makes masks here instead of "auto": an artifact's key must not hide what is installed."""
    mesh = profile.mesh.model_copy(update={"decimator": resolve_decimator(profile.mesh.decimator)})
    ingest = profile.ingest.model_copy(update={"mask_network": resolve_network(profile.ingest.mask_network)})
    return profile.model_copy(update={"mesh": mesh, "ingest": ingest})


def _source_names(sources: dict[str, Path]) -> dict[str, list[str]]:
    """Names of the input files in the folders of photos and masks."""
    names = {"photos": source_files(sources["photos"])}
    if "masks" in sources and sources["masks"].is_dir():
        names["masks"] = list_masks(sources["masks"])
    for kind in ("normals", "depths"):
        if kind in sources:
            names[kind] = [path.name for path in sorted(sources[kind].iterdir()) if path.suffix.lower() in (".npy", ".png")]
    return names


def _priors(project: Project, profile: Profile) -> dict[str, Path]:
    """Folders of given normals and depths beside the photos' folder, where the profile has a weight for them."""
    if project.photos is None:
        return {}
    weights = {"normals": profile.coupling.prior_normals, "depths": profile.coupling.prior_depths}
    folders = {kind: Path(project.photos).parent / kind for kind, weight in weights.items() if weight}
    return {kind: folder for kind, folder in folders.items() if folder.is_dir()}


def _default_out(photos: Path | None) -> Path:
    """out/<name of photos>, or the only run in out/. Raises UsageError."""
    if photos is not None:
        folder = photos.resolve()
        name = folder.parent.name if folder.name in PHOTO_FOLDERS else folder.stem if folder.is_file() else folder.name
        return Path("out") / (portable_name(name) if name else "")
    runs = sorted(path.parent for path in Path("out").glob("*/project.json"))
    if len(runs) == 1:
        return runs[0]
    if not runs:
        raise UsageError("There is no run in ./out yet: give the folder of photos, or name the run with --out.")
    raise UsageError(f"There are {len(runs)} runs in ./out ({', '.join(p.name for p in runs[:5])}…): name one with --out.")


def _store(store: str | Path | None) -> str | None:
    if store == "":
        raise UsageError("The shared store's name is empty.")
    return None if store is None else str(store)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path.resolve())


def _path(text: str | Path | None) -> Path | None:
    """The path of an argument; an empty one is refused, because `Path("")` is the current folder."""
    if text == "":
        raise UsageError("A path is empty; '.' is the current folder.")
    return None if text is None else Path(text)
