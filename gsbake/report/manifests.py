"""Parts of the report from the stages' manifests: times, memory, decisions, warnings, results and settings.

Any entry of a manifest may be missing (a stage whose output the user replaced has no times); missing entries are skipped.
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
from gsbake.report.html import Check, Decision, SkipDecision, StageRow, StageWarning
from gsbake.text import duration, number, size

#: Stages in running order.
ORDER = ("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export")
#: Names of photo folders inside a capture; the capture's name is that of the parent folder.
PHOTO_FOLDERS = {"photos", "images", "image", "input", "imgs", "rgb"}

Manifests = Mapping[str, Mapping[str, Any]]


def load_manifests(inputs: Mapping[str, Path]) -> dict[str, dict[str, Any]]:
    """{stage: manifest} of the stage folders in running order; a missing or unreadable manifest is empty."""
    out: dict[str, dict[str, Any]] = {}
    for stage in ORDER:
        if stage not in inputs:
            continue
        try:
            body = json.loads((inputs[stage] / "manifest.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            body = {}
        out[stage] = body if isinstance(body, dict) else {}
    return out


def total_seconds(manifests: Manifests) -> float:
    """Sum of the stages' seconds."""
    return sum(float(m.get("seconds") or 0) for m in manifests.values())


def peak(manifests: Manifests) -> tuple[float, str]:
    """Largest peak memory of a stage in bytes, and the stage's name; 0 and "" when none is known."""
    known = [(float(m["peak_bytes"]), stage) for stage, m in manifests.items() if m.get("peak_bytes")]
    return max(known, default=(0.0, ""))


def time_chart(manifests: Manifests) -> str:
    """Bar chart of the stages' seconds, divided into parts."""
    rows = []
    for stage, manifest in manifests.items():
        seconds = float(manifest.get("seconds") or 0)
        parts = tuple((name, float(value)) for name, value in (manifest.get("parts") or {}).items())
        rows.append(Bar(stage, seconds, duration(seconds) if manifest.get("seconds") is not None else "replaced", parts))
    return bars(rows, "Seconds per stage")


def memory_chart(manifests: Manifests) -> str:
    """Bar chart of the stages' peak memory."""
    values = [(stage, float(m.get("peak_bytes") or 0)) for stage, m in manifests.items()]
    return bars([Bar(stage, value, size(value) if value else "–") for stage, value in values], "Peak memory per stage")


def decisions(manifests: Manifests) -> tuple[Decision, ...]:
    """All decisions except those on skipped work, in running order."""
    return tuple(
        Decision(stage, *(str(d.get(k, "")) for k in ("what", "choice", "evidence")))
        for stage, d in _all_decisions(manifests)
        if not str(d.get("what", "")).startswith(SKIP_PREFIX)
    )


def skip_decisions(manifests: Manifests) -> tuple[SkipDecision, ...]:
    """Decisions on every rule of [skip], in the order of the settings; empty when no stage decided on any."""
    found: dict[str, list[SkipDecision]] = {}
    for stage, d in _all_decisions(manifests):
        rule, saved = str(d.get("what", "")), d.get("saved_s")
        if rule.startswith(SKIP_PREFIX):
            time = "" if saved is None else f"about {duration(float(saved))}"
            found.setdefault(rule, []).append(SkipDecision(rule, stage, str(d.get("choice", "")), str(d.get("evidence", "")), time))
    rules = dict.fromkeys([*(SKIP_PREFIX + rule for rule in Skip.model_fields), *found]) if found else {}
    missing = "not applicable", "no stage of this run has this step", ""
    return tuple(row for rule in rules for row in found.get(rule, [SkipDecision(rule, "", *missing)]))


def _all_decisions(manifests: Manifests) -> Iterator[tuple[str, Mapping[str, Any]]]:
    return ((stage, d) for stage, m in manifests.items() for d in m.get("decisions") or ())


def warnings(manifests: Manifests) -> tuple[StageWarning, ...]:
    """Warnings of all stages in running order."""
    return tuple(StageWarning(stage, str(text)) for stage, m in manifests.items() for text in m.get("warnings") or ())


def format_value(value: Any) -> str:
    """A result or setting as short text: numbers by `gsbake.text.number`, lists and mappings joined."""
    if isinstance(value, bool | int | float):
        return number(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {format_value(v)}" for k, v in value.items()) or "–"
    if isinstance(value, Sequence) and not isinstance(value, str):
        shown = ", ".join(format_value(v) for v in value[:12])
        return (f"{shown}, … ({len(value)})" if len(value) > 12 else shown) or "–"
    return "–" if value is None or value == "" else str(value)


def _rows(values: Mapping[str, Any], show: Any = format_value) -> tuple[tuple[str, str], ...]:
    return tuple((str(k), show(v)) for k, v in values.items())


def stage_rows(manifests: Manifests) -> tuple[StageRow, ...]:
    """Per stage: results, times of its parts, settings and environment."""
    out = []
    for stage, m in manifests.items():
        seconds, memory = m.get("seconds"), m.get("peak_bytes")
        summary = " · ".join(([duration(seconds)] if seconds is not None else []) + ([size(memory)] if memory else []))
        host = m.get("host") or {}
        seed = None if m.get("seed") is None else str(m["seed"])
        environment = {k: host.get(k) for k in ("cpu", "cores")} | {k: m.get(k) for k in ("threads", "backend")} | {"seed": seed}
        tables = (
            ("Results", _rows(m.get("results") or {})),
            ("Parts", _rows(m.get("parts") or {}, duration)),
            ("Settings", _rows(m.get("settings") or {})),
            ("Environment", _rows({k: v for k, v in environment.items() if v is not None})),
        )
        out.append(StageRow(str(m.get("title") or stage), summary or "replaced by the user", tables))
    return tuple(out)


def run_note(manifests: Manifests) -> str:
    """Total time and machine as one line."""
    host: Mapping[str, Any] = next((m["host"] for m in manifests.values() if m.get("host")), {})
    threads = next((m["threads"] for m in manifests.values() if m.get("threads")), None)
    words = [f"{duration(total_seconds(manifests))} in all stages"]
    if host.get("cpu"):
        words.append(f"{host['cpu']}, {host.get('cores', '?')} cores")
    if threads:
        words.append(f"{threads} thread{'s' if threads > 1 else ''}")
    return ", ".join(words) + ". Cached stages show the time of the run that computed them."


def capture_name(manifests: Manifests) -> str:
    """Name of the capture's folder; "Asset" when the manifests do not contain it."""
    path = ((manifests.get("ingest") or {}).get("inputs") or {}).get("photos", {}).get("path", "")
    for folder in (Path(path), *Path(path).parents):
        if folder.name and folder.name.lower() not in PHOTO_FOLDERS:
            return folder.name
    return "Asset"


def read_log(path: Path) -> dict[str, list[float]]:
    """{column: values} of a training log; empty without one. Raises BadInputError when it is not a table of numbers."""
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        return {name: [float(row[name] or "nan") for row in rows] for name in (rows[0] if rows else {})}
    except (TypeError, ValueError) as error:
        raise BadInputError(f"{path} is not a table of numbers ({error}); train again.") from error


def training_charts(logs: Mapping[str, Mapping[str, Sequence[float]]]) -> tuple[str, ...]:
    """Charts of the logged figures; the steps of a log are offset by those of the log before."""
    titles = {"psnr": "PSNR (dB)", "surfels": "Surfels", "sdf_median": "Median SDF sample |s|", "gamma": "Sharpness γ"}
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
    """Rules of the export's audit; empty without the file. Raises BadInputError when it is not an audit."""
    if not path.exists():
        return ()
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, list):
            raise TypeError("no list of findings")
        return tuple(Check(str(f["rule"]), _state(bool(f["passed"]), str(f["severity"])), format_value(f["detail"])) for f in found)
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise BadInputError(f"{path} is not an audit ({error}); export the asset again.") from error
