"""The engine: takes stages in order, serves what is cached, runs what is not, and publishes it with a manifest."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsbake.errors import GsbakeError, InterruptedRun
from gsbake.pipeline.events import EventLog, now
from gsbake.pipeline.files import disk_error, open_output, remove_tree
from gsbake.pipeline.key import HASH_FORMAT, SHORT, Ingredients
from gsbake.pipeline.lease import Holder, Lease
from gsbake.pipeline.machine import host_facts, versions
from gsbake.pipeline.plan import Planner, Request, StageState
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Stage
from gsbake.pipeline.store import Artifact, Store
from gsbake.pipeline.supervise import Outcome, StageFailed, StopSignals, supervise
from gsbake.pipeline.worker import Job


class Observer:
    """Watches a run; the command line's displays derive from it. Every method may be left out."""

    def begins(self, stages: list[Stage]) -> None:
        """A run over these stages starts."""

    def served(self, state: StageState) -> None:
        """A stage is cached or was replaced by hand."""

    def starts(self, state: StageState) -> None:
        """A stage starts to run, for the state's reasons."""

    def waits(self, name: str, holder: Holder | None) -> None:
        """Somebody else computes this artifact; called again and again while waiting."""

    def progress(self, name: str, done: int, total: int, text: str, live: Mapping[str, float]) -> None:
        """A stage reports progress."""

    def decided(self, name: str, what: str, choice: str, evidence: str) -> None:
        """A stage took a decision."""

    def warned(self, name: str, text: str) -> None:
        """A stage warns."""

    def stopping(self, name: str) -> None:
        """A stop was asked for and passed on to the stage."""

    def finished(self, state: StageState) -> None:
        """A stage was published; the state holds its artifact."""


class Engine:
    """Runs the stages of a registry for one request."""

    def __init__(self, registry: Registry, request: Request, observer: Observer | None = None) -> None:
        self.registry = registry
        self.request = request
        self.observer = observer or Observer()
        self.store = Store(request.out)
        self.planner = Planner(request, self.store)
        self.events = EventLog(request.out / "events.jsonl")

    def plan(self, target: str | None = None) -> list[StageState]:
        """What `run` would do, without doing it."""
        states = self.planner.plan(self.registry.up_to(target))
        self.store.digests.save()
        return states

    def run(self, target: str | None = None) -> list[StageState]:
        """Bring every stage up to `target` (all without one) up to date and return their states, artifacts included.

        Raises BadInputError, UsageError, InterruptedRun, or StageFailed with the path of the saved traceback.
        """
        stages = self.registry.up_to(target)
        try:
            open_output(self.request.out)
            with StopSignals() as stop:
                return self._run(stages, stop)
        except GsbakeError as error:
            self.events.write("run ended", error=type(error).__name__, message=str(error), exit_code=error.exit_code)
            raise
        except OSError as error:
            known = disk_error(error, self.request.out)
            if known is None:
                raise
            raise known from error
        finally:
            self.store.digests.save()

    def _run(self, stages: list[Stage], stop: StopSignals) -> list[StageState]:
        start = time.perf_counter()
        self.events.write("run started", stages=[s.name for s in stages], seed=self.request.seed, device=self.request.device)
        self.observer.begins(stages)
        states: list[StageState] = []
        artifacts: dict[str, Artifact] = {}
        for stage in stages:
            stop.check()
            state = self.planner.assess(stage, artifacts)
            if state.artifact is None:
                state = self._compute(stage, state, artifacts, stop)
            else:
                self.events.write("stage cached", stage=stage.name, folder=state.artifact.folder, by_hand=state.artifact.by_hand)
                self.observer.served(state)
            assert state.artifact is not None
            artifacts[stage.name] = state.artifact
            states.append(state)
        self.events.write("run ended", exit_code=0, seconds=round(time.perf_counter() - start, 3))
        return states

    def _compute(self, stage: Stage, state: StageState, artifacts: Mapping[str, Artifact], stop: StopSignals) -> StageState:
        """Run a stage under its lease, unless somebody else has published its output in the meantime."""
        what = state.ingredients
        assert what is not None
        lease = Lease(self.store.stage_folder(stage.name) / f"{what.key[:SHORT]}.lease")

        def on_wait(holder: Holder | None) -> None:
            stop.check()
            self.observer.waits(stage.name, holder)

        lapsed = lease.acquire(on_wait)
        with lease:
            if lapsed is not None:
                self.events.write("lease taken over", stage=stage.name, holder=str(lapsed))
            self.store.sweep(stage.name, what.key)
            again = self.planner.assess(stage, artifacts)
            if again.artifact is not None:
                self.observer.served(again)
                return again
            self.events.write("stage started", stage=stage.name, key=what.key, reasons=list(state.reasons))
            self.observer.starts(state)
            artifact = self._execute(stage, state, what, artifacts, stop)
        done = StageState(stage.name, stage.title, "run", state.reasons, what, artifact, state.settings)
        self.events.write(
            "stage finished", stage=stage.name, seconds=artifact.manifest["seconds"], peak_bytes=artifact.manifest["peak_bytes"],
            results=artifact.manifest["results"],
        )  # fmt: skip
        self.observer.finished(done)
        return done

    def _execute(
        self, stage: Stage, state: StageState, what: Ingredients, artifacts: Mapping[str, Artifact], stop: StopSignals
    ) -> Artifact:
        request, store = self.request, self.store
        files = self.planner.input_files(stage, artifacts)
        inputs = {need: artifacts[need].folder for need in stage.needs}
        inputs |= {name: request.sources[name] for name in stage.sources if name in request.sources}
        checkpoint = store.checkpoint(stage.name, what.key)
        checkpoint.mkdir(parents=True, exist_ok=True)
        resumed = any(checkpoint.iterdir())
        temporary = store.temporary(stage.name, what.key)
        schema = type(request.profile)
        job = Job(
            stage=self.registry.references[stage.name],
            out=str(temporary.resolve()),
            inputs={name: str(path.resolve()) for name, path in inputs.items()},
            schema=f"{schema.__module__}:{schema.__qualname__}",
            profile=request.profile.model_dump(mode="json"),
            seed=request.seed,
            threads=request.threads,
            device=request.device if stage.uses_device else "cpu",
            checkpoint=str(checkpoint.resolve()),
            place=str(request.out),
            parent=os.getpid(),
        )
        started = now()
        try:
            log = request.out / "logs" / f"{stage.name}-{what.key[:SHORT]}.log"
            log.parent.mkdir(exist_ok=True)
            outcome = supervise(job, log, stop, lambda message: self._relay(stage.name, message))
            manifest = self._manifest(stage, state, what, outcome, started, resumed)
            manifest["inputs"] = {
                name: {"path": str(inputs[name]), "digest": what.inputs[name], "files": dict(files[name])} for name in sorted(files)
            }
            artifact = store.publish(temporary, store.folder(stage.name, what.key), manifest)
        except StageFailed as error:
            raise StageFailed(f"{stage.title} failed: {error}; the traceback is in '{self._save_error(stage.name, error)}'.") from error
        except InterruptedRun as error:
            raise InterruptedRun(f"{stage.title}: {error}") from error
        finally:
            if temporary.exists():
                remove_tree(temporary)
            with suppress(OSError):
                checkpoint.rmdir()  # goes only when the stage left nothing in it
        remove_tree(checkpoint)
        return artifact

    def _relay(self, name: str, message: Mapping[str, Any]) -> None:
        """Pass a worker's message to the observer and the log."""
        match message["kind"]:
            case "progress":
                live = {k: v for k, v in message["live"].items() if v is not None}
                self.observer.progress(name, message["done"], message["total"], message["text"], live)
            case "decision":
                self.events.write("decision", stage=name, **{k: v for k, v in message.items() if k != "kind"})
                self.observer.decided(name, message["what"], message["choice"], message["evidence"])
            case "warning":
                self.events.write("warning", stage=name, text=message["text"])
                self.observer.warned(name, message["text"])
            case "stop sent":
                self.events.write("stop sent", stage=name)
                self.observer.stopping(name)

    def _manifest(
        self, stage: Stage, state: StageState, what: Ingredients, outcome: Outcome, started: str, resumed: bool
    ) -> dict[str, Any]:
        return {
            "stage": stage.name,
            "title": stage.title,
            "version": stage.version,
            "key": what.key,
            "key_format": HASH_FORMAT,
            "started": started,
            "finished": now(),
            "resumed": resumed,
            "seconds": round(outcome.seconds, 3),
            "parts": {name: round(seconds, 3) for name, seconds in outcome.parts.items()},
            "peak_bytes": outcome.peak_bytes,
            "results": outcome.results,
            "decisions": outcome.decisions,
            "warnings": outcome.warnings,
            "reasons": list(state.reasons),
            "settings": dict(state.settings),
            "seed": what.seed,
            "backend": what.backend,
            "threads": self.request.threads,
            "host": host_facts(),
            "versions": versions(),
        }

    def _save_error(self, name: str, error: StageFailed) -> Path:
        folder = self.request.out / "errors"
        folder.mkdir(exist_ok=True)
        path = folder / f"{now().replace(':', '-')[:19]}-{name}.txt"
        path.write_text(error.details)
        return path


def artifacts_of(states: Iterable[StageState]) -> dict[str, Artifact]:
    """{stage: artifact} of the states that have one."""
    return {state.name: state.artifact for state in states if state.artifact is not None}
