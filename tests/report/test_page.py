"""HTML page (complete, escaped, offline) and SVG charts (well-formed, to scale)."""

from __future__ import annotations

import base64
import hashlib
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from gsbake.report.charts import Bar, Curve, bars, labels, lines, log_ticks, number, ticks
from gsbake.report.html import (
    Check,
    Comparison,
    Decision,
    Figure,
    Light,
    Page,
    Panel,
    SkipDecision,
    StageRow,
    StageWarning,
    hdr_base64,
    image_uri,
    inline_script,
    render_page,
)

GREY = np.full((8, 12, 3), 0.5, np.float32)
URI = image_uri(GREY)

EMPTY = Page(
    title="a & b <mug>", lead="3 photos", figures=(Figure("PSNR", "27.1 dB", "8 photos"),), warnings=(), model="", lights=(),
    comparisons=(), comparison_note="", relit_title="Under other environments", relit=(), relit_note="", maps=(), maps_note="", audit=(),
    curves=(), curves_note="", skip_decisions=(), decisions=(), stages=(), time_chart="", memory_chart="", run_note="", footer="gsbake",
)  # fmt: skip

FULL = replace(
    EMPTY,
    warnings=(StageWarning("poses", "<script>alert(1)</script>"),),
    model=base64.b64encode(b"glTF").decode(),
    lights=(Light("Studio", hdr_base64(GREY)),),
    comparisons=(Comparison("IMG_1", URI, URI, 27.123, 0.9234, True), Comparison("IMG_2", URI, URI, 21.0, 0.8, False)),
    relit=(Panel("Sunset", "front", image_uri(GREY, GREY[..., 0])),),
    maps=(Panel("Base colour", "1024", URI),),
    masks=(Panel("IMG_7", "automatic mask", URI),),
    audit=(Check("triangles", "pass", "29 998"), Check("size", "fail", "9 MB")),
    curves=(lines([Curve("train", [0, 1, 2], [20, 21, 22])], "PSNR"),),
    skip_decisions=(SkipDecision("skip.converged_steps", "train", "stopped", "gain < 0.05 dB", "about 12 s"),),
    decisions=(Decision("poses", "structure from motion", "skipped", "poses given"),),
    stages=(StageRow("Training", "12 s", (("Results", (("psnr", "27.1"),)), ("Settings", ()))),),
    time_chart=bars([Bar("train", 12, "12 s", (("steps", 9.0), ("eval", 3.0)))], "time"),
    memory_chart=bars([], "memory"),
)  # fmt: skip


class Outline(HTMLParser):
    """Tags with attributes, text outside scripts, and open elements."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)


def outline(html: str) -> Outline:
    parsed = Outline()
    parsed.feed(html)
    parsed.close()
    assert parsed.open == []
    return parsed


@pytest.mark.parametrize("page", [EMPTY, FULL], ids=["empty", "full"])
def test_nothing_is_fetched(page: Page) -> None:
    parsed = outline(render_page(page))
    for tag, attrs in parsed.tags:
        for name in ("src", "href", "data", "poster"):
            value = attrs.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name, value)
    assert not any(tag in ("iframe", "object", "embed") for tag, _ in parsed.tags)
    styles = re.findall(r"<style>(.*?)</style>", render_page(page), re.DOTALL)
    assert styles and not any(word in text for text in styles for word in ("url(", "@import"))


def test_sections_without_data_are_omitted() -> None:
    ids = {attrs.get("id") for _, attrs in outline(render_page(FULL)).tags}
    assert {"asset", "quality", "masks", "relit", "maps", "audit", "training", "run", "model", "light-1"} <= ids
    bare = outline(render_page(EMPTY))
    ids = {attrs.get("id") for _, attrs in bare.tags}
    assert not ids & {"asset", "quality", "masks", "relit", "maps", "audit", "training", "model"} and "run" in ids
    assert not any(tag == "model-viewer" for tag, _ in bare.tags)
    anchors = {attrs["href"] for tag, attrs in bare.tags if tag == "a"}
    assert anchors == {"#run"}


def test_text_is_escaped_and_figures_are_shown() -> None:
    html = render_page(FULL)
    text = " ".join(outline(html).text)
    assert "a & b <mug>" in text and "<script>alert(1)</script>" in text and "<script>alert" not in html
    for words in ("27.12 dB", "0.923", "training photo", "poses given", "29 998", "27.1", "skip.converged_steps", "gain < 0.05", "12 s"):
        assert words in text


def test_model_and_viewer_are_inlined() -> None:
    html = render_page(FULL)
    found = re.search(r'<script id="model" type="text/plain">(.*?)</script>', html, re.DOTALL)
    assert found and base64.b64decode(found[1]) == b"glTF"
    assert "ModelViewerElement" in html and "ModelViewerElement" not in render_page(EMPTY)


def test_script_text_cannot_close_its_element() -> None:
    text = str(inline_script("a = '</script><!-- <script>';"))
    assert "</script" not in text and "<!--" not in text
    viewer = re.findall(r"<script>(.*?)</script>", render_page(FULL), re.DOTALL)
    assert len(viewer) == 2 and len(viewer[0]) > 900_000 and viewer[1].startswith('"use strict"')


def test_encoded_images_keep_their_values() -> None:
    ramp = np.linspace(0, 1, 64, dtype=np.float32)[None, :, None] * np.ones((16, 1, 3), np.float32)
    for alpha, kind in ((None, "image/jpeg"), (np.ones((16, 64), np.float32), "image/webp")):
        head, data = image_uri(ramp, alpha).split(",")
        assert head == f"data:{kind};base64"
        back = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(back[..., :3] / 255, ramp, atol=0.04)
    red = image_uri(np.full((16, 16, 3), 0.5, np.float32) * np.float32([2, 0, 0]))
    back = cv2.imdecode(np.frombuffer(base64.b64decode(red.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    assert back[8, 8, 2] > 245 and back[8, 8, :2].max() < 12


def test_hdr_file_keeps_radiance() -> None:
    light = np.array([[[0.1, 2.0, 30.0]] * 8] * 4, np.float32)
    data = base64.b64decode(hdr_base64(light))
    assert data.startswith(b"#?RADIANCE") or data.startswith(b"#?RGBE")
    back = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    # Shared exponent of the three channels: the error is 1/256 of the largest.
    np.testing.assert_allclose(back[..., ::-1], light, atol=30 / 256 * 1.01)


def test_bars_are_to_scale() -> None:
    root = ET.fromstring(bars([Bar("a", 10, "10 s", (("x", 6), ("y", 4))), Bar("b & c", 40, "40 s")], "times"))
    whole = [float(r.get("width", "0")) for r in root.iter("rect") if r.get("class") == "bar"]
    assert whole[1] == pytest.approx(4 * whole[0], abs=0.2)
    parts = [r for r in root.iter("rect") if "part" in str(r.get("class"))]
    assert float(parts[0].get("width", "0")) == pytest.approx(0.6 * whole[0], abs=0.2)
    assert float(parts[1].get("x", "0")) == pytest.approx(float(parts[0].get("x", "0")) + 0.6 * whole[0], abs=0.2)
    assert any("b & c" in (t.text or "") for t in root.iter("text"))
    ET.fromstring(bars([Bar("a", 0.0, "0 s", (("x", 0.0),))], "no times"))


def test_lines_rise_when_values_rise_and_skip_gaps() -> None:
    root = ET.fromstring(lines([Curve("<a>", [0, 1, 2, 3], [1, float("nan"), 3, 4]), Curve("b", [0, 3], [4, 1])], "t"))
    first, second = sorted(root.iter("polyline"), key=lambda p: str(p.get("class")))
    points = [tuple(map(float, p.split(","))) for p in str(first.get("points")).split()]
    assert len(points) == 3
    assert points[0][1] > points[1][1] > points[2][1]  # SVG's y grows downwards
    other = [tuple(map(float, p.split(","))) for p in str(second.get("points")).split()]
    assert other[0] == pytest.approx((points[0][0], points[2][1]))
    assert lines([Curve("one point", [1], [1])], "t") == ""
    assert lines([], "t") == ""


def test_lines_whose_axis_has_one_tick() -> None:
    root = ET.fromstring(lines([Curve("surfels", [0, 1, 2], [39054, 39500, 39808])], "t"))
    assert len(root.findall(".//{*}path")) + len(root.findall(".//{*}polyline")) > 0


def test_log_lines_are_straight_for_exponentials() -> None:
    x = list(range(11))
    root = ET.fromstring(lines([Curve("a", x, [10.0**-i for i in x])], "t", log=True))
    points = np.array([tuple(map(float, p.split(","))) for p in str(next(root.iter("polyline")).get("points")).split()])
    np.testing.assert_allclose(np.diff(points[:, 1]), np.diff(points[:, 1])[0], atol=0.11)


def test_log_ticks() -> None:
    np.testing.assert_allclose(log_ticks(0.9, 31), [1, 2, 5, 10, 20])
    np.testing.assert_allclose(log_ticks(1e-4, 1.5), [1e-4, 1e-3, 1e-2, 1e-1, 1])
    np.testing.assert_allclose(log_ticks(4e-3, 2), [1e-2, 3e-2, 1e-1, 3e-1, 1])


def test_labels_distinguish_ticks() -> None:
    assert labels([20.32, 20.34]) == ["20.32", "20.34"]
    assert labels([0.0, 500.0, 1000.0]) == ["0", "500", "1k"]
    assert labels([1e-4, 2e-4]) == ["1e-4", "2e-4"] and labels([3.0]) == ["3"]
    narrow = lines([Curve("a", [0, 1], [20.33, 20.34])], "t", log=True)
    shown = [t.text for t in ET.fromstring(narrow).iter("text") if t.get("text-anchor") == "end"]
    assert len(shown) >= 2 and len(set(shown)) == len(shown)


def test_long_curves_are_downsampled() -> None:
    x = list(range(30_000))
    root = ET.fromstring(lines([Curve("a", x, [float(i) for i in x])], "t"))
    points = str(next(root.iter("polyline")).get("points")).split()
    assert 200 <= len(points) <= 240


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0, 10) == [0, 5, 10]
    np.testing.assert_allclose(ticks(18.2, 31.0), [20, 25, 30])
    np.testing.assert_allclose(ticks(-0.07, 0.11), [-0.05, 0, 0.05, 0.1])
    assert ticks(3, 3) == [3]


@pytest.mark.parametrize(("value", "text"), [(0, "0"), (0.25, "0.25"), (12, "12"), (3000, "3k"), (2.5e6, "2.5M"), (1e-4, "1e-4")])
def test_numbers(value: float, text: str) -> None:
    assert number(value) == text


def digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@pytest.mark.parametrize("page", [EMPTY, FULL], ids=["empty", "full"])
def test_only_the_pages_own_scripts_and_styles_run(page: Page) -> None:
    html = render_page(page)
    parsed = outline(html)
    policy = next(a["content"] or "" for tag, a in parsed.tags if a.get("http-equiv") == "Content-Security-Policy")
    rules = {rule.split()[0]: rule.split()[1:] for rule in policy.split("; ")}
    assert (
        rules["default-src"] == ["'none'"]
        and rules["base-uri"] == ["'none'"]
        and not any("unsafe-inline" in rule for rule in rules.values())
    )
    assert {source for rule in rules.values() for source in rule if "'" not in source} == {"data:", "blob:"}  # nothing from elsewhere
    # the policy holds from its place on, so nothing that runs may stand before it
    assert html.index("Content-Security-Policy") < min(html.index("<style"), html.index("<script"), html.index("<title"))
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    styles = re.findall(r"<style>(.*?)</style>", html, re.DOTALL)  # with those that the viewer puts into the page
    assert len(scripts) == (2 if page.model else 1) and len(styles) == (2 if page.model else 1)
    assert {digest(text) for text in scripts} <= set(rules["script-src"]) and {digest(text) for text in styles} == set(rules["style-src"])
    assert not any(name.startswith("on") or name == "style" for _, attributes in parsed.tags for name in attributes)
    assert not any(tag == "script" and attributes.get("type") not in (None, "text/plain") for tag, attributes in parsed.tags)
