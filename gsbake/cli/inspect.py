"""`gsbake status`, `explain` and `profiles`: state of the stages, cache keys and settings."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Console

from gsbake.api import Session
from gsbake.cli.options import Options
from gsbake.cli.output import cell, print_json, print_table, print_text
from gsbake.config.load import DEFAULT, LoadedProfile, bounds, fields, load_profile, shipped
from gsbake.pipeline.plan import StageState
from gsbake.pipeline.settings import flatten
from gsbake.studio.live import LiveRun
from gsbake.text import duration, figures, size

_WORDS = {"cached": "cached", "replaced": "replaced", "run": "will run", "waits": "will run"}
_STYLES = {"cached": "green", "replaced": "cyan", "run": "yellow", "waits": "yellow"}


def print_plan(states: list[StageState]) -> None:
    """Print a table of the stages: state, time, memory, and reason or results."""
    rows = []
    for state in states:
        manifest = state.artifact.manifest if state.artifact is not None else None
        rows.append((
            state.name,
            cell(_WORDS[state.status], _STYLES[state.status]),
            duration(manifest["seconds"]) if manifest else "",
            size(manifest["peak_bytes"]) if manifest else "",
            figures(manifest["results"]) if manifest and state.status == "cached" else "; ".join(state.reasons),
        ))  # fmt: skip
    print_table(("stage", "state", "time", "memory", "reason or results"), rows)


def plan_document(session: Session, states: list[StageState]) -> dict[str, Any]:
    """The plan as JSON."""
    return {
        "out": str(session.out),
        "profile": session.profile.name,
        "stages": [
            {
                "name": state.name,
                "status": state.status,
                "will_run": state.artifact is None,
                "reasons": list(state.reasons),
                "key": state.cache_key.digest if state.cache_key is not None else None,
                "folder": str(state.artifact.folder) if state.artifact is not None else None,
                "settings": dict(state.settings),
                "inputs": dict(state.cache_key.inputs) if state.cache_key is not None else {},
                "results": state.artifact.manifest.get("results", {}) if state.artifact is not None else {},
                "decisions": state.artifact.manifest.get("decisions", []) if state.artifact is not None else [],
            }
            for state in states
        ],
    }


def status(options: Options) -> None:
    """Print the state of every stage."""
    session = options.session()
    states = session.engine.plan()
    live = LiveRun.read(session.out)
    running = live.holder if live is not None and live.runs else None
    if options.as_json:
        print_json(plan_document(session, states) | {"running": None if running is None else {"host": running.host, "pid": running.pid}})
        return
    project = session.project
    if not options.quiet:
        if live is not None and running is not None:
            print_text(f"{session.out}: a run is in progress, {running}: {live.summary}")
        print_text(f"{session.out}: photos {project.photos}, profile {project.profile} {' '.join(project.overrides)}".rstrip())
    print_plan(states)


def explain(options: Options, stage: str | None) -> None:
    """Print the inputs of the cache key and the reasons to run, for one stage or all."""
    session = options.session()
    session.engine.registry.up_to(stage)  # raises UsageError for an unknown stage
    states = [s for s in session.engine.plan(stage) if stage is None or s.name == stage]
    if options.as_json:
        print_json(plan_document(session, states))
        return
    console = Console(highlight=False, soft_wrap=True)
    origins, given = session.profile.origins, flatten(session.profile.profile)
    for state in states:
        console.print(cell(f"{state.name}: {_WORDS[state.status]}", f"bold {_STYLES[state.status]}"))
        for reason in state.reasons:
            console.print(cell(f"  because {reason}"))
        if state.artifact is not None:
            console.print(cell(f"  in {state.artifact.folder}"))
            for d in state.artifact.manifest.get("decisions", ()):
                console.print(cell(f"  decided {d['what']}: {d['choice']} ({d['evidence']})"))
        if state.cache_key is not None:
            what = state.cache_key
            console.print(cell(f"  key {what.digest[:16]} from stage version {what.version}"))
            for name, digest in what.inputs.items():
                console.print(cell(f"    input {name}: content {digest[:16]}"))
            if what.backend is not None:
                console.print(cell(f"    device {what.backend}"))
            if what.seed is not None:
                console.print(cell(f"    seed {what.seed}"))
        for name, value in state.settings.items():
            resolved = "" if given[name] == value else f"{given[name]}, "  # "auto", resolved for this machine
            console.print(cell(f"    {name} = {value}  ({resolved}{origins[name]})"))


def list_profiles(everything: bool, as_json: bool) -> None:
    """Print the shipped profiles for assets, or `everything`."""
    loaded = {name: load_profile(name).profile for name in shipped()}
    found = {name: profile.description for name, profile in loaded.items() if everything or profile.group == "assets"}
    if as_json:
        print_json(found)
        return
    print_table(("profile", "for"), [(f"{name} (default)" if name == DEFAULT else name, text) for name, text in found.items()])
    if others := len(loaded) - len(found):
        print_text(f"`gsbake profiles NAME` shows one; --all lists {others} published systems too.")


def show_profile(name: str, overrides: list[str], as_json: bool) -> None:
    """Print every setting of a profile with its value, source, and help."""
    loaded = load_profile(name, overrides)
    values = setting_values(loaded)
    known = fields()
    if as_json:
        document = {
            key: {"value": value, "origin": loaded.origins[key], "allowed": bounds(known[key]), "help": known[key].description}
            for key, value in values.items()
        }
        print_json(document)
        return
    rows = []
    for key, value in values.items():
        allowed = bounds(known[key])
        text = f"{known[key].description}{f' ({allowed})' if allowed else ''}"
        rows.append((key, json.dumps(value, ensure_ascii=False), loaded.origins[key], text))
    print_table(("setting", "value", "source", "help"), rows)


def setting_values(loaded: LoadedProfile) -> dict[str, Any]:
    """{"section.key": value} of all settings."""
    body = loaded.profile.model_dump(mode="json")
    out = {}
    for key in fields():
        section, dot, name = key.partition(".")
        if dot:
            out[key] = body[section][name]
    return out
