"""Build engine: takes stages in order, reuses cached artifacts, runs the other stages and publishes their output with a manifest."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError, InterruptedRun, UsageError
from gsbake.own_files import SET_ASIDE
from gsbake.pipeline.digest import file_stamps
from gsbake.pipeline.events import EventLog, now
from gsbake.pipeline.files import disk_error, ensure_output_folder, remove_tree
from gsbake.pipeline.key import KEY_FORMAT, KEY_PREFIX_LENGTH, CacheKey
from gsbake.pipeline.lease import Lease, LeaseHolder
from gsbake.pipeline.machine import host_info, versions
from gsbake.pipeline.plan import Planner, Request, StageState
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.shared_store import SharedStore
from gsbake.pipeline.stage import Stage
from gsbake.pipeline.store import Artifact, Store, lease_path
from gsbake.pipeline.store_files import StoreUnreachableError
from gsbake.pipeline.supervise import Outcome, StageFailed, StopSignals, supervise
from gsbake.pipeline.uses import Uses, forget_killed
from gsbake.pipeline.worker import Job
from gsbake.text import printable, shortlist, summarise


class Observer:
    """Receives the events of a run. Base class of the command line's displays; every method is optional."""

    def run_started(self, stages: list[Stage]) -> None:
        """A run of these stages starts."""

    def stage_reused(self, state: StageState) -> None:
        """A stage is cached, or its output was replaced by the user."""

    def stage_started(self, state: StageState) -> None:
        """A stage starts, for the state's reasons."""

    def stage_waiting(self, name: str, holder: LeaseHolder | None) -> None:
        """Another process computes the artifact; called at every poll while waiting."""

    def part_started(self, name: str, part: str) -> None:
        """A stage starts a part whose time is measured; see `parts` of the manifest."""

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """A stage reports progress."""

    def decision(self, name: str, what: str, choice: str, evidence: str) -> None:
        """A stage reports a decision."""

    def warning(self, name: str, text: str) -> None:
        """A stage reports a warning."""

    def stage_stopping(self, name: str) -> None:
        """A stop request was sent to the stage."""

    def stage_finished(self, state: StageState) -> None:
        """The artifact of a stage was published; `state` holds it."""


class Engine:
    """Runs the stages of a registry for one request."""

    def __init__(
        self, registry: Registry, request: Request, observer: Observer | None = None, shared: SharedStore | None = None
    ) -> None:
        self.registry = registry
        self.shared = shared
        self.request = request
        self.observer = observer or Observer()
        self.store = Store(request.out)
        self.planner = Planner(request, self.store)
        self.events = EventLog(request.out / "events.jsonl")
        #: Artifacts that are not deleted meanwhile; to be entered by who reads them after a run.
        self.uses = Uses(request.out)
        #: Called before a stage starts to compute, with a function that raises InterruptedRun on a stop request.
        self.before_stage: Callable[[Stage, Callable[[], None]], None] = lambda stage, check: None
        #: Stages that the present or last run has finished, whether or not it went on to the end.
        self.finished: list[StageState] = []

    def plan(self, until: str | None = None) -> list[StageState]:
        """The states of the stages that `run` would take; nothing is run."""
        states = self.planner.plan(self.registry.up_to(until))
        self.store.digests.save()
        return states

    def run(self, until: str | None = None, on_accepted: Callable[[], None] | None = None) -> list[StageState]:
        """Bring all stages up to `until` (all without one) up to date; returns their states with artifacts.

        `on_accepted` is called once the inputs were read and the first stage's state is known, before anything is computed.
        Raises BadInputError, UsageError, InterruptedRun, or StageFailed, which names the file with the traceback.
        """
        stages = self.registry.up_to(until)
        try:
            with StopSignals() as stop, self.uses:
                fault = self._look_at_shared_store()
                ensure_output_folder(self.request.out)
                return self._run(stages, stop, on_accepted or (lambda: None), fault)
        except GsbakeError as error:
            self.events.write("run ended", error=type(error).__name__, message=str(error), exit_code=error.exit_code)
            raise
        except OSError as error:
            user_error = disk_error(error, self.request.out)
            if user_error is None:
                raise
            raise user_error from error
        finally:
            self.store.digests.save()

    def _run(
        self, stages: list[Stage], stop: StopSignals, on_accepted: Callable[[], None], fault: StoreUnreachableError | None
    ) -> list[StageState]:
        start = time.perf_counter()
        forget_killed(self.request.out)
        self.events.write("run started", stages=[s.name for s in stages], seed=self.request.seed, device=self.request.device)
        self.observer.run_started(stages)
        if fault is not None:
            self._give_store_up(stages[0].name, fault)
        states = self.finished = []
        artifacts: dict[str, Artifact] = {}
        for stage in stages:
            stop.check()
            self._set_aside_unexpected(stage, artifacts)
            state = self.planner.assess(stage, artifacts)
            if not states:
                on_accepted()
            if state.artifact is None or not (self.uses.add(state.artifact.folder) or state.artifact.replaced):
                state = self._compute(stage, state, artifacts, stop)
            else:
                self.store.mark_used(state.artifact)
                self.events.write("stage cached", stage=stage.name, folder=state.artifact.folder, replaced=state.artifact.replaced)
                self.observer.stage_reused(state)
                self._share(stage, state, stop)
            assert state.artifact is not None
            artifacts[stage.name] = state.artifact
            states.append(state)
        self.events.write("run ended", exit_code=0, seconds=round(time.perf_counter() - start, 3))
        return states

    def _set_aside_unexpected(self, stage: Stage, artifacts: Mapping[str, Artifact]) -> None:
        known = all(need in artifacts for need in stage.needs)
        self.store.set_aside_unexpected(stage.name, self.planner.cache_key(stage, artifacts) if known else None)
        self._report_moved(stage.name)

    def _report_moved(self, name: str) -> None:
        """Say which files were set aside, and where."""
        moved = self.store.take_moved()
        if moved:
            folder = self.request.out / SET_ASIDE
            self.warn(name, f"{shortlist([path.name for path in moved])}: not what the stage wrote; moved to '{folder}'.")

    def warn(self, name: str, text: str) -> None:
        """A warning that does not come from a stage's own work."""
        text = printable(text)
        self.events.write("warning", stage=name, text=text)
        self.observer.warning(name, text)

    def _compute(self, stage: Stage, state: StageState, artifacts: Mapping[str, Artifact], stop: StopSignals) -> StageState:
        """Run a stage under its lease, unless another process has published its artifact meanwhile."""
        cache_key = state.cache_key
        assert cache_key is not None
        folder = self.store.folder(stage.name, cache_key.digest)
        lease = Lease(lease_path(folder))

        def on_wait(holder: LeaseHolder | None) -> None:
            stop.check()
            self.observer.stage_waiting(stage.name, holder)

        stale_holder = lease.acquire(on_wait)
        with lease:
            if stale_holder is not None:
                self.events.write("lease taken over", stage=stage.name, holder=str(stale_holder))
            self.uses.add(folder)  # before the lease ends
            self.store.remove_leftovers(stage.name, cache_key.digest)
            state = self.planner.assess(stage, artifacts)
            if state.artifact is not None:
                self.observer.stage_reused(state)
                return state
            fetched = self._fetch(stage, state, cache_key, stop)
            if fetched is not None:
                self.observer.stage_reused(fetched)
                return fetched
            self.before_stage(stage, stop.check)
            self.events.write("stage started", stage=stage.name, key=cache_key.digest, reasons=list(state.reasons))
            self.observer.stage_started(state)
            artifact = self._execute(stage, state, cache_key, artifacts, stop, lease)
            artifact = self._share(stage, replace(state, artifact=artifact), stop) or artifact
        done = StageState(stage.name, stage.title, "run", state.reasons, cache_key, artifact, state.settings)
        self.events.write(
            "stage finished", stage=stage.name, seconds=artifact.manifest["seconds"], peak_bytes=artifact.manifest["peak_bytes"],
            results=artifact.manifest["results"],
        )  # fmt: skip
        self.observer.stage_finished(done)
        return done

    def _fetch(self, stage: Stage, state: StageState, cache_key: CacheKey, stop: StopSignals) -> StageState | None:
        """Take the artifact of a key from the shared store; None where it has none. The caller holds the lease."""
        if self.shared is None:
            return None
        temporary = self.store.temporary(stage.name, cache_key.digest)
        try:
            manifest = self.shared.fetch(cache_key, temporary, stop.check)
            self._report_store(stage.name, "thrown away; the stage is computed again")
            if manifest is None:
                return None
            own = {name: value for name, value in manifest.items() if name not in ("files", "digest", "seal")}
            artifact = self.store.publish(temporary, self.store.folder(stage.name, cache_key.digest), own)
            self._report_moved(stage.name)
        except (StoreUnreachableError, UsageError) as error:
            self._give_store_up(stage.name, error)
            return None
        finally:
            if temporary.exists():
                remove_tree(temporary)
        self.events.write("stage fetched", stage=stage.name, key=cache_key.digest, store=self.shared.url)
        return StageState(stage.name, stage.title, "cached", ("from the shared store",), cache_key, artifact, state.settings)

    def _share(self, stage: Stage, state: StageState, stop: StopSignals) -> Artifact | None:
        """Put an artifact into the shared store. Where another machine has stored other bytes for the key meanwhile, theirs are taken and
        returned, so that all machines go on from the same files."""
        if self.shared is None or state.artifact is None or state.cache_key is None:
            return None
        try:
            refused = self.shared.put(state.artifact, stop.check)
            self._report_store(stage.name, "replaced")
            if refused == "full":
                self._warn_of_store(stage.name, "it is full; the output stays on this machine. `gsbake cache gc --store` makes room.")
            theirs = None if refused else self.shared.digest_of(state.cache_key, stop.check)
            if state.status == "run" and theirs is not None and theirs != state.artifact.digest:
                fetched = self._fetch(stage, state, state.cache_key, stop)
                return None if fetched is None else fetched.artifact
        except (StoreUnreachableError, UsageError) as error:
            self._give_store_up(stage.name, error)
        return None

    def _look_at_shared_store(self) -> StoreUnreachableError | None:
        """What keeps the shared store from being used; None where nothing does. Raises UsageError for a folder that is none."""
        try:
            if self.shared is not None:
                self.shared.require()
        except StoreUnreachableError as error:
            return error
        return None

    def _give_store_up(self, name: str, error: Exception) -> None:
        self._warn_of_store(name, f"it cannot be used ({error}); the run goes on without it.")
        self.shared = None

    def _report_store(self, name: str, what: str) -> None:
        """One warning about what was damaged in the shared store, and one for each of its notices."""
        assert self.shared is not None
        damaged, notices = self.shared.damaged, self.shared.notices
        self.shared.damaged, self.shared.notices = [], []
        for text in [f"{shortlist(damaged)}: damaged and {what}."] * bool(damaged) + notices:
            self._warn_of_store(name, text)

    def _warn_of_store(self, name: str, what: str) -> None:
        self.warn(name, f"Shared store '{self.shared.url if self.shared is not None else ''}': {what}")

    def _execute(
        self, stage: Stage, state: StageState, cache_key: CacheKey, artifacts: Mapping[str, Artifact], stop: StopSignals, lease: Lease
    ) -> Artifact:
        """Run a stage in a worker process and publish its output."""
        request, store = self.request, self.store
        files = self.planner.input_files(stage, artifacts)
        inputs = {need: artifacts[need].folder for need in stage.needs}
        inputs |= {name: request.sources[name] for name in stage.sources if name in request.sources}
        checkpoint = store.checkpoint(stage.name, cache_key.digest)
        checkpoint.mkdir(parents=True, exist_ok=True)
        resumed = any(checkpoint.iterdir())
        temporary = store.temporary(stage.name, cache_key.digest)
        job = self._job(stage, temporary, inputs, checkpoint)
        started = now()
        try:
            log = request.out / "logs" / f"{stage.name}-{cache_key.digest[:KEY_PREFIX_LENGTH]}.log"
            log.parent.mkdir(exist_ok=True)
            stamps = file_stamps(self.planner.input_paths(stage, artifacts))
            outcome = supervise(job, log, stop, lambda message: self._relay(stage.name, message))
            self._check_inputs(stage, artifacts, files, stamps)
            manifest = self._manifest(stage, state, cache_key, outcome, started, resumed)
            manifest["inputs"] = {
                name: {"path": str(inputs[name]), "digest": cache_key.inputs[name], "files": dict(files[name])} for name in sorted(files)
            }
            if not lease.held():
                raise InterruptedRun("Another process took over the lease; the same command goes on with its result.")
            artifact = store.publish(temporary, store.folder(stage.name, cache_key.digest), manifest)
            self._report_moved(stage.name)
        except StageFailed as error:
            raise StageFailed(f"{stage.title} failed: {error}; the traceback is in '{self._save_traceback(stage.name, error)}'.") from error
        except InterruptedRun as error:
            raise InterruptedRun(f"{stage.title}: {error}") from error
        finally:
            if temporary.exists():
                remove_tree(temporary)
            with suppress(OSError):
                checkpoint.rmdir()  # succeeds only when empty
        remove_tree(checkpoint)
        return artifact

    def _check_inputs(
        self, stage: Stage, artifacts: Mapping[str, Artifact], files: Mapping[str, Mapping[str, str]], stamps: Mapping[Path, Any]
    ) -> None:
        """Raise InterruptedRun when an input is no longer what the cache key says, or was written to while the stage ran.

        The key's digests were taken before `stamps`, so files whose digest the planner took earlier are read again where their stamps
        are not those of the digest.
        """
        self.planner.forget_sources()
        now_files = self.planner.input_files(stage, artifacts)
        changed = sorted(path.name for path, stamp in file_stamps(stamps).items() if stamp != stamps[path])
        for name, entry in files.items():
            changed += sorted(file for file, digest in entry.items() if now_files[name].get(file) != digest)
        if changed:
            raise InterruptedRun(f"{shortlist(sorted(set(changed)))} changed while the stage ran; run the same command again.")

    def _job(self, stage: Stage, out: Path, inputs: Mapping[str, Path], checkpoint: Path) -> Job:
        """The worker's job: run `stage` on `inputs` and write into the folder `out`."""
        request, cache = self.request, self.store.cache(stage.name)
        self.uses.add(cache)
        with suppress(OSError):
            os.utime(cache)  # for the garbage collection
        schema = type(request.profile)
        return Job(
            stage=self.registry.references[stage.name],
            out=str(out.resolve()),
            inputs={name: str(path.resolve()) for name, path in inputs.items()},
            schema=f"{schema.__module__}:{schema.__qualname__}",
            profile=request.profile.model_dump(mode="json"),
            seed=request.seed,
            threads=request.threads,
            device=request.device if stage.uses_device else "cpu",
            checkpoint=str(checkpoint.resolve()),
            cache=str(cache.resolve()),
            output_folder=str(request.out),
            parent=os.getpid(),
        )

    def _relay(self, name: str, message: Mapping[str, Any]) -> None:
        """Pass a worker's message to the observer and the event log."""
        match message["kind"]:
            case "part":
                self.observer.part_started(name, message["name"])
            case "progress":
                live = {k: v for k, v in message["live"].items() if v is not None}
                self.observer.progress(name, message["done"], message["total"], message["text"], live)
            case "decision":
                self.events.write("decision", stage=name, **{k: v for k, v in message.items() if k != "kind"})
                self.observer.decision(name, message["what"], message["choice"], message["evidence"])
            case "warning":
                self.events.write("warning", stage=name, text=message["text"])
                self.observer.warning(name, message["text"])
            case "stop sent":
                self.events.write("stop sent", stage=name)
                self.observer.stage_stopping(name)

    def _manifest(
        self, stage: Stage, state: StageState, cache_key: CacheKey, outcome: Outcome, started: str, resumed: bool
    ) -> dict[str, Any]:
        return {
            "stage": stage.name,
            "title": stage.title,
            "version": stage.version,
            "key": cache_key.digest,
            "key_format": KEY_FORMAT,
            "started": started,
            "finished": now(),
            "resumed": resumed,
            "seconds": round(outcome.seconds, 3),
            "parts": {name: round(seconds, 3) for name, seconds in outcome.parts.items()},
            "peak_bytes": outcome.peak_bytes,
            "results": outcome.results,
            "summary": summarise(stage.summary, outcome.results),
            "decisions": outcome.decisions,
            "warnings": outcome.warnings,
            "reasons": list(state.reasons),
            "settings": dict(state.settings),
            "seed": cache_key.seed,
            "backend": cache_key.backend,
            "threads": self.request.threads,
            "host": host_info(),
            "versions": versions(),
        }

    def _save_traceback(self, name: str, error: StageFailed) -> Path:
        folder = self.request.out / "errors"
        folder.mkdir(exist_ok=True)
        path = folder / f"{now().replace(':', '-')[:19]}-{name}.txt"
        path.write_bytes(error.details.encode(errors="backslashreplace"))
        return path


def artifacts_by_stage(states: Iterable[StageState]) -> dict[str, Artifact]:
    """{stage: artifact} of the states with an artifact."""
    return {state.name: state.artifact for state in states if state.artifact is not None}
