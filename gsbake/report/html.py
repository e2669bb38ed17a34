"""HTML page of the report: plain data filled into a Jinja template, as one file that opens offline.

Images, model, style, script and the 3D viewer (vendored, see `vendor/`) are inlined; nothing is fetched. All text is made printable, and
Jinja escapes it.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from gsbake.text import printable


@dataclass(frozen=True)
class Figure:
    """A headline figure."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class StageWarning:
    """A warning of a stage."""

    stage: str
    text: str
    advice: str = ""


@dataclass(frozen=True)
class Comparison:
    """Photo, render and error heat map of one view as data URIs, with PSNR (dB) and SSIM."""

    name: str
    photo: str
    render: str
    psnr: float
    ssim: float
    held_out: bool
    error: str = ""


@dataclass(frozen=True)
class Panel:
    """An image (data URI) with title and caption; `channel` names a map of the asset that the 3D view can show."""

    title: str
    caption: str
    image: str
    channel: str = ""


@dataclass(frozen=True)
class Light:
    """Environment map of the 3D view: name and Radiance HDR file in base64."""

    name: str
    hdr: str


@dataclass(frozen=True)
class Check:
    """One rule of the audit; `state` is pass, warn, fail or info."""

    rule: str
    state: str
    detail: str


@dataclass(frozen=True)
class Decision:
    """A decision of a stage and its evidence."""

    stage: str
    what: str
    choice: str
    evidence: str


@dataclass(frozen=True)
class SkipDecision:
    """Decision on a rule of [skip]: setting, stage, choice, evidence, and the time saved where it is known."""

    rule: str
    stage: str
    choice: str
    evidence: str
    saved: str


@dataclass(frozen=True)
class StageRow:
    """Manifest of a stage as tables (heading, rows of key and value)."""

    title: str
    summary: str
    tables: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]


@dataclass(frozen=True)
class Page:
    """Contents of the page. Charts are SVG from `gsbake.report.charts`; `model` is the GLB in base64, empty for no 3D view; `map` is
    the JSON of `gsbake.report.coverage.map_json`, empty for no map; `places` say from where to photograph what no photo saw; `close_up`
    are a part of a photo and of the asset, pixel for pixel."""

    title: str
    lead: str
    figures: tuple[Figure, ...]
    warnings: tuple[StageWarning, ...]
    model: str
    lights: tuple[Light, ...]
    comparisons: tuple[Comparison, ...]
    comparison_note: str
    relit_title: str
    relit: tuple[Panel, ...]
    relit_note: str
    maps: tuple[Panel, ...]
    maps_note: str
    audit: tuple[Check, ...]
    curves: tuple[str, ...]
    curves_note: str
    skip_decisions: tuple[SkipDecision, ...]
    decisions: tuple[Decision, ...]
    stages: tuple[StageRow, ...]
    time_chart: str
    memory_chart: str
    run_note: str
    footer: str
    masks: tuple[Panel, ...] = ()
    panoramas: tuple[Panel, ...] = ()
    map: str = ""
    places: tuple[str, ...] = ()
    close_up: tuple[Panel, ...] = ()


#: Scripts of the page, which are one: what is on every page, the map of cameras, the views of the asset.
SCRIPTS = ("page.js", "page_map.js", "page_views.js")


def image_uri(rgb: NDArray[np.floating], alpha: NDArray[np.floating] | None = None, quality: int = 88) -> str:
    """Data URI of an sRGB image (h, w, 3) in 0..1: JPEG, or WebP with `alpha` (h, w)."""
    bgr = np.round(255 * np.clip(rgb[..., ::-1], 0, 1)).astype(np.uint8)
    if alpha is None:
        return _uri(bgr, ".jpg", "image/jpeg", [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111])
    cover = np.round(255 * np.clip(alpha, 0, 1)).astype(np.uint8)
    return _uri(np.dstack([bgr, cover]), ".webp", "image/webp", [cv2.IMWRITE_WEBP_QUALITY, quality])


def _uri(image: NDArray[np.uint8], ending: str, kind: str, options: list[int]) -> str:
    done, data = cv2.imencode(ending, image, options)
    if not done:
        raise RuntimeError(f"could not encode an image of shape {image.shape} as {kind}")
    return f"data:{kind};base64," + base64.b64encode(data.tobytes()).decode()


def hdr_base64(radiance: NDArray[np.floating]) -> str:
    """Equirectangular radiance map (h, w, 3) as a Radiance HDR file in base64."""
    done, data = cv2.imencode(".hdr", np.ascontiguousarray(radiance[..., ::-1], np.float32))
    if not done:
        raise RuntimeError(f"could not encode an environment map of shape {radiance.shape} as HDR")
    return base64.b64encode(data.tobytes()).decode()


def inline_script(text: str) -> Markup:
    """Script text for a script element: sequences that would close or nest the element are escaped."""
    return Markup(text.replace("<!--", "<\\!--").replace("</script", "<\\/script"))


def content_security_policy(scripts: Iterable[str], styles: Iterable[str]) -> str:
    """Policy under which a browser runs only these scripts and styles, and loads nothing but data inside the page (W3C, *Content Security
    Policy Level 3*): markup that slipped through from a name could neither run nor send anything."""

    def digests(texts: Iterable[str]) -> str:
        return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in texts)

    return "; ".join((
        "default-src 'none'", f"script-src {digests(scripts)} 'wasm-unsafe-eval'", f"style-src {digests(styles)}", "img-src data: blob:",
        "connect-src data: blob:",  # the viewer reads model and environment maps from URLs of data in the page
        "base-uri 'none'", "form-action 'none'",
    ))  # fmt: skip


def _viewer_styles(script: str) -> list[str]:
    """The style sheets that the viewer's script puts into the page."""
    return re.findall(r"<style>(.*?)</style>", script, re.DOTALL)


def _shown(value: object) -> object:
    """What the template shows of a value: text is made printable, markup and numbers stay."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def render_page(page: Page) -> str:
    """HTML of the page."""
    here = resources.files("gsbake.report")

    def text(name: str) -> str:
        return here.joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, finalize=_shown
    )
    template = environment.from_string(text("page.html.j2"))
    charts = {name: Markup(getattr(page, name)) for name in ("time_chart", "memory_chart")}
    filled = {**vars(page), **charts, "curves": tuple(Markup(curve) for curve in page.curves), "map": Markup(page.map)}
    css, page_js = text("page.css"), inline_script("".join(text(name) for name in SCRIPTS))
    viewer_js = inline_script(text("vendor/model-viewer.min.js") if page.model else "")
    policy = content_security_policy([page_js, viewer_js], [css, *_viewer_styles(viewer_js)])
    return template.render(page=filled, css=Markup(css), page_js=page_js, viewer_js=viewer_js, policy=policy)
