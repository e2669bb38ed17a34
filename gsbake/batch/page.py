"""The index of a batch: one HTML page without any outside file, with a thumbnail, figures and the end of every capture."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
from blake3 import blake3
from markupsafe import Markup
from PIL import Image

from gsbake.atomic import write_atomic
from gsbake.batch.captures import CapturePlan
from gsbake.batch.coordinator import Outcome
from gsbake.own_files import own_place
from gsbake.text import duration, number, printable, size

INDEX = "index.html"
#: Edge of a thumbnail in pixels.
_THUMBNAIL = 96


@dataclass(frozen=True)
class Cell:
    """A figure: its text, and the number by which the column is sorted."""

    text: str = ""
    value: float = -1.0


@dataclass(frozen=True)
class Row:
    """One capture."""

    name: str
    state: str
    message: str
    thumbnail: str
    report: str
    asset: str
    cells: tuple[Cell, ...]


COLUMNS = ("photos", "triangles", "asset", "PSNR", "SSIM", "time", "memory")


def write_index(outcomes: Sequence[Outcome], root: Path) -> Path:
    """Write ROOT/index.html; returns its path, which is `index.new.html` where that is not as gsbake wrote it."""
    path = own_place(root / INDEX, _is_sealed)
    write_atomic(path, _sealed(render([_row(outcome, root) for outcome in outcomes])))
    return path


def _sealed(page: str) -> str:
    """The page with a last line by which gsbake knows a page that nobody has edited."""
    return f"{page.rstrip()}\n<!-- gsbake {blake3(page.rstrip().encode()).hexdigest()} -->\n"


def _is_sealed(path: Path) -> bool:
    with suppress(OSError, ValueError):
        text = path.read_bytes().decode()
        return text == _sealed(text.rpartition("<!-- gsbake ")[0])
    return False


def render(rows: Sequence[Row]) -> str:
    """The page of the rows."""
    folder = resources.files("gsbake.batch")
    script = folder.joinpath("index.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.finalize = lambda value: printable(value) if type(value) is str else value
    page = environment.from_string(folder.joinpath("index.html.j2").read_text(encoding="utf-8"))
    counts = {state: sum(row.state == state for row in rows) for state in ("done", "running", "failed", "unfinished")}
    # `script` is gsbake's own file, and the only one that the policy allows.
    return page.render(rows=rows, columns=COLUMNS, counts=counts, script=Markup(script), script_digest=digest)


def _row(outcome: Outcome, root: Path) -> Row:
    plan = outcome.plan
    asset, report = (plan.files.get(name) or plan.out / name for name in ("asset.glb", "report.html"))
    artifact = next((state.artifact for state in plan.states if state.name == "export"), None)
    return Row(
        name=plan.name,
        state="done" if outcome.state == "cached" else outcome.state,
        message=outcome.message,
        thumbnail=_thumbnail(artifact.folder / "previews") if artifact is not None else "",
        report=_link(report, root),
        asset=_link(asset, root),
        cells=figures_of(plan),
    )


def figures_of(plan: CapturePlan) -> tuple[Cell, ...]:
    """The figures of COLUMNS of a capture, as far as its stages have run."""
    manifests = {state.name: state.artifact.manifest for state in plan.states if state.artifact is not None}
    results: dict[str, Mapping[str, Any]] = {name: manifest.get("results", {}) for name, manifest in manifests.items()}
    seconds = sum(float(manifest.get("seconds", 0)) for manifest in manifests.values())
    peak = max((int(manifest.get("peak_bytes", 0)) for manifest in manifests.values()), default=0)
    quality, export = results.get("report", {}), results.get("export", {})
    asset = plan.files.get("asset.glb") or plan.out / "asset.glb"
    return (
        _figure(results.get("ingest", {}).get("photos"), number),
        _figure(export.get("triangles"), number),
        _figure(asset.stat().st_size if asset.is_file() else None, size),
        _figure(quality.get("psnr"), lambda v: f"{v:.1f} dB"),
        _figure(quality.get("ssim"), lambda v: f"{v:.3f}"),
        _figure(seconds or None, duration),
        _figure(peak or None, size),
    )


def _figure(value: object, text: Any) -> Cell:
    return Cell(text(value), float(value)) if isinstance(value, int | float) else Cell()


def _link(path: Path, root: Path) -> str:
    """Relative address of a file; empty where there is none."""
    return quote(path.relative_to(root).as_posix()) if path.is_file() and path.is_relative_to(root) else ""


def _thumbnail(folder: Path) -> str:
    """The first preview of an asset as a small JPEG in a data URI; empty without one."""
    for path in sorted(folder.glob("*.png"))[:1]:
        with suppress(OSError, ValueError), Image.open(path) as image:
            small = image.convert("RGB")
            small.thumbnail((_THUMBNAIL, _THUMBNAIL))
            body = io.BytesIO()
            small.save(body, "JPEG", quality=85)
            return "data:image/jpeg;base64," + base64.b64encode(body.getvalue()).decode()
    return ""
