"""The captures of a batch: their output folders, the states of their stages, and the number and size of their photos.

A capture that cannot be planned (no photos, an unreadable file) becomes a failure with its sentence; the others are planned all the same.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from gsbake.api import RunOptions, Session, open_session
from gsbake.capture.sources import PHOTO_FOLDERS
from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.pipeline.engine import artifacts_by_stage
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.store_url import has_credentials
from gsbake.publish import published_results
from gsbake.system.names import portable_name, same_file_key
from gsbake.timing.photos import USUAL_MEGAPIXELS, PhotoSet, photos_of_request


@dataclass(frozen=True)
class BatchOptions:
    """Options that all captures of a batch share; `root` holds one output folder per capture, `store` is the shared store, `moved` says
    that photos of earlier runs lie at other paths now."""

    root: Path
    profile: str
    overrides: Sequence[str] = ()
    threads: int = 0
    seed: int = 0
    store: str | None = None
    moved: bool = False

    def absolute(self) -> BatchOptions:
        """The options with absolute paths, which jobs in other folders need."""
        profile = str(Path(self.profile).absolute()) if Path(self.profile).is_file() else self.profile
        store = self.store if self.store is None or "://" in self.store else str(Path(self.store).absolute())
        return replace(self, root=self.root.absolute(), profile=profile, store=store)

    @property
    def named_store(self) -> str | None:
        """The store as files and commands may name it; None where its address has credentials and jobs take it from GSBAKE_STORE."""
        return None if has_credentials(self.store) else self.store


@dataclass(frozen=True)
class CapturePlan:
    """A capture, its output folder, and the states of its stages; or the failure that keeps it from being planned."""

    name: str
    photos: Path
    out: Path
    states: tuple[StageState, ...] = ()
    photo_set: PhotoSet = PhotoSet(0, USUAL_MEGAPIXELS)
    files: Mapping[str, Path | None] = field(default_factory=dict)  # {result: where it lies in the output folder, None where it does not}
    error: str = ""
    exit_code: int = 0

    @property
    def to_run(self) -> tuple[StageState, ...]:
        """The stages that are neither cached nor replaced."""
        return tuple(state for state in self.states if state.artifact is None)

    @property
    def done(self) -> bool:
        """Whether nothing is left to run or to publish."""
        return not self.error and not self.to_run and None not in self.files.values()


def plan_captures(captures: Sequence[Path], options: BatchOptions) -> list[CapturePlan]:
    """Plans of the captures, in order. Raises UsageError when two captures have one name, or for a wrong profile or setting."""
    named = {path: _name(path) for path in captures}
    seen: dict[str, Path] = {}
    for path, name in named.items():
        other = seen.setdefault(same_file_key(name), path)
        if other != path:
            raise UsageError(f"'{other}' and '{path}' have the same name '{name}' and would share an output folder; rename one.")
    return [plan_capture(path, options) for path in named]


def plan_capture(photos: Path, options: BatchOptions) -> CapturePlan:
    """The plan of one capture. Raises UsageError for a wrong profile or setting, which concerns all captures, and for an output folder that
    is not gsbake's own or holds the run of other photos."""
    out = (options.root / _name(photos)).absolute()
    plan = CapturePlan(_name(photos), photos.absolute(), out)
    try:
        if not photos.is_dir():
            raise BadInputError(f"'{photos}' is not a folder; name the folder of a capture.")
        session = open_session(
            RunOptions(photos, out, options.profile, options.overrides, threads=options.threads, seed=options.seed, moved=options.moved),
        )
        states = states_of(session)
    except UsageError:
        raise
    except GsbakeError as error:
        return CapturePlan(plan.name, plan.photos, out, error=str(error), exit_code=error.exit_code)
    files = published_results(session.out, artifacts_by_stage(states), session.project)
    return CapturePlan(plan.name, plan.photos, out, tuple(states), photos_of_request(session.engine.request), files)


def states_of(session: Session) -> list[StageState]:
    """The states of the stages. Photos are read only where something is stored: else a batch would begin with the digests of all photos."""
    engine = session.engine
    if engine.store.stage_folder("").exists():
        return engine.plan()
    return engine.planner.plan_empty(engine.registry.up_to(None))


def _name(photos: Path) -> str:
    """Name of a capture, which is that of its output folder: the folder's, or its parent's for a folder such as images/."""
    folder = photos.resolve()
    name = folder.parent.name if folder.name in PHOTO_FOLDERS else folder.name
    if not name:
        raise UsageError(f"'{photos}' has no name for an output folder; name the folder of a capture.")
    return portable_name(name)


def identifier(index: int, name: str) -> str:
    """An identifier of a capture for schedulers: letters, digits and underscores, and unique by its index."""
    return f"c{index:04d}_{re.sub(r'[^A-Za-z0-9]+', '_', name)[:24].strip('_')}".rstrip("_")


def plan_state_key(session: Session) -> str:
    """Cache key of the first stage of a session that has to run; empty when none has, or where it cannot be known."""
    with suppress(GsbakeError):
        session.engine.planner.forget_sources()
        return next((s.cache_key.digest for s in session.engine.plan() if s.artifact is None and s.cache_key is not None), "")
    return ""
