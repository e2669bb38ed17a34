"""What the stages' manifests say, as parts of the report: times, memory, decisions, warnings, results and settings.

A manifest may lack anything (a stage whose output a person put in place by hand has no times): what is missing is left out.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsbake.config.schema import Skip
from gsbake.errors import BadInputError
from gsbake.monitor import SKIP_PREFIX
from gsbake.report.charts import Bar, Curve, bars, lines
from gsbake.report.html import Check, Decision, LeftOut, StageRow, Warned
from gsbake.text import duration, size

#: Stages in the order they run in.
ORDER = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export")
#: Folders that a capture keeps its photos in; the capture's name is the folder above.
PHOTO_FOLDERS = {"photos", "images", "image", "input", "imgs", "rgb"}

Manifests = Mapping[str, Mapping[str, Any]]


def load_manifests(inputs: Mapping[str, Path]) -> dict[str, dict[str, Any]]:
    """{stage: manifest} of the stage folders, in running order; a folder without a readable manifest counts as an empty one."""
    out: dict[str, dict[str, Any]] = {}
    for stage in ORDER:
        if stage not in inputs:
            continue
        try:
            body = json.loads((inputs[stage] / "manifest.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            body = {}
        out[stage] = body if isinstance(body, dict) else {}
    return out


def total_seconds(manifests: Manifests) -> float:
    """Seconds of all stages together."""
    return sum(float(m.get("seconds") or 0) for m in manifests.values())


def peak(manifests: Manifests) -> tuple[float, str]:
    """Largest memory of any stage in bytes, and that stage; 0 and no name when none is known."""
    known = [(float(m["peak_bytes"]), stage) for stage, m in manifests.items() if m.get("peak_bytes")]
    return max(known, default=(0.0, ""))


def time_chart(manifests: Manifests) -> str:
    """Bars of the stages' seconds, divided into their parts."""
    rows = []
    for stage, manifest in manifests.items():
        seconds = float(manifest.get("seconds") or 0)
        parts = tuple((name, float(value)) for name, value in (manifest.get("parts") or {}).items())
        rows.append(Bar(stage, seconds, duration(seconds) if manifest.get("seconds") is not None else "by hand", parts))
    return bars(rows, "Seconds per stage")


def memory_chart(manifests: Manifests) -> str:
    """Bars of the stages' peak memory."""
    values = [(stage, float(m.get("peak_bytes") or 0)) for stage, m in manifests.items()]
    return bars([Bar(stage, value, size(value) if value else "–") for stage, value in values], "Peak memory per stage")


def decisions(manifests: Manifests) -> tuple[Decision, ...]:
    """All decisions but those on work left out, in running order."""
    return tuple(
        Decision(stage, *(str(d.get(k, "")) for k in ("what", "choice", "evidence")))
        for stage, d in _decided(manifests)
        if not str(d.get("what", "")).startswith(SKIP_PREFIX)
    )


def left_out(manifests: Manifests) -> tuple[LeftOut, ...]:
    """Every rule on work left out, in the order of the settings, with what was decided; none where no stage decided on any."""
    found: dict[str, list[LeftOut]] = {}
    for stage, d in _decided(manifests):
        what, saved = str(d.get("what", "")), d.get("saved_s")
        if what.startswith(SKIP_PREFIX):
            time = "" if saved is None else f"about {duration(float(saved))}"
            found.setdefault(what, []).append(LeftOut(what, stage, str(d.get("choice", "")), str(d.get("evidence", "")), time))
    rules = dict.fromkeys([*(SKIP_PREFIX + rule for rule in Skip.model_fields), *found]) if found else {}
    return tuple(row for rule in rules for row in found.get(rule, [LeftOut(rule, "", "not asked", "this run has no such step", "")]))


def _decided(manifests: Manifests) -> Iterator[tuple[str, Mapping[str, Any]]]:
    return ((stage, d) for stage, m in manifests.items() for d in m.get("decisions") or ())


def warnings(manifests: Manifests) -> tuple[Warned, ...]:
    """All warnings, in running order."""
    return tuple(Warned(stage, str(text)) for stage, m in manifests.items() for text in m.get("warnings") or ())


def readable(value: Any) -> str:
    """A result or setting as short text: numbers with four significant digits, lists and mappings joined."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {readable(v)}" for k, v in value.items()) or "–"
    if isinstance(value, Sequence) and not isinstance(value, str):
        shown = ", ".join(readable(v) for v in value[:12])
        return (f"{shown}, … ({len(value)})" if len(value) > 12 else shown) or "–"
    return "–" if value is None or value == "" else str(value)


def _rows(values: Mapping[str, Any], show: Any = readable) -> tuple[tuple[str, str], ...]:
    return tuple((str(k), show(v)) for k, v in values.items())


def stage_rows(manifests: Manifests) -> tuple[StageRow, ...]:
    """Per stage its results, parts, settings and where it ran."""
    out = []
    for stage, m in manifests.items():
        seconds, memory = m.get("seconds"), m.get("peak_bytes")
        summary = " · ".join(([duration(seconds)] if seconds is not None else []) + ([size(memory)] if memory else []))
        host = m.get("host") or {}
        place = {k: host.get(k) for k in ("cpu", "cores")} | {k: m.get(k) for k in ("threads", "backend", "seed")}
        tables = (
            ("Results", _rows(m.get("results") or {})),
            ("Parts", _rows(m.get("parts") or {}, duration)),
            ("Settings", _rows(m.get("settings") or {})),
            ("Where", _rows({k: v for k, v in place.items() if v is not None})),
        )
        out.append(StageRow(str(m.get("title") or stage), summary or "put in place by hand", tables))
    return tuple(out)


def run_note(manifests: Manifests) -> str:
    """One line on the machine and the total time."""
    host: Mapping[str, Any] = next((m["host"] for m in manifests.values() if m.get("host")), {})
    threads = next((m["threads"] for m in manifests.values() if m.get("threads")), None)
    words = [f"{duration(total_seconds(manifests))} in all stages"]
    if host.get("cpu"):
        words.append(f"{host['cpu']}, {host.get('cores', '?')} cores")
    if threads:
        words.append(f"{threads} threads")
    return ", ".join(words) + ". Times are those of the runs that made the files; a cached stage is not run again."


def capture_name(manifests: Manifests) -> str:
    """The capture's name: the folder the photos came from; "Asset" when no manifest tells it."""
    path = ((manifests.get("ingest") or {}).get("inputs") or {}).get("photos", {}).get("path", "")
    for folder in (Path(path), *Path(path).parents):
        if folder.name and folder.name.lower() not in PHOTO_FOLDERS:
            return folder.name
    return "Asset"


def read_log(path: Path) -> dict[str, list[float]]:
    """Columns of a training log as numbers; empty when there is none. Raises BadInputError when it is not a table of numbers."""
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        return {name: [float(row[name] or "nan") for row in rows] for name in (rows[0] if rows else {})}
    except (TypeError, ValueError) as error:
        raise BadInputError(f"{path} is not a table of numbers ({error}); train again.") from error


def training_charts(logs: Mapping[str, Mapping[str, Sequence[float]]]) -> tuple[str, ...]:
    """Charts of the columns that the logs have; the steps of a later log go on where the one before ended."""
    titles = {"psnr": "PSNR (dB)", "surfels": "Surfels", "sdf_median": "Median distance |s|", "gamma": "Sharpness γ"}
    charts = []
    for column, title in titles.items():
        curves, start = [], 0.0
        for name, log in logs.items():
            steps = log.get("step") or list(range(len(log.get(column, ()))))
            if column in log and len(steps):
                offset = start if steps[0] < start else 0.0
                curves.append(Curve(name, [step + offset for step in steps], log[column]))
                start = steps[-1] + offset
        charts.append(lines(curves, title, log=column in ("sdf_median", "gamma")))
    return tuple(chart for chart in charts if chart)


def _state(passed: bool, severity: str) -> str:
    return "pass" if passed else {"error": "fail", "warning": "warn"}.get(severity, "info")


def audit_rows(path: Path) -> tuple[Check, ...]:
    """The lines of the export's audit; none when the file is absent. Raises BadInputError when it is not an audit."""
    if not path.exists():
        return ()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, list):
            raise TypeError("no list of findings")
        return tuple(Check(str(f["rule"]), _state(bool(f["passed"]), str(f["severity"])), readable(f["detail"])) for f in found)
    except (ValueError, LookupError, TypeError) as error:
        raise BadInputError(f"{path} is not an audit ({error}); export the asset again.") from error
