"""From an empty folder to a downloaded asset in headless Chromium, driven by Playwright; then the server is killed in the middle of a run.

Pictures of every tab are written to $GSBAKE_STUDIO_PICTURES, from where they come into the guide: docs/guide/img.
"""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest

from gsbake.geometry.cameras import CameraSet
from gsbake.python_process import python_command, python_environment
from gsbake.studio.server import MODULES
from tests.support.browser import chromium

#: Seconds that a run of the smallest profile may take, on a machine with other work.
RUN_SECONDS = 1200
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--force-color-profile=srgb"]
SIZE = {"width": 1280, "height": 800}
#: A drop of files, as a file manager makes it.
DROP = """async ([selector, files]) => {
  const carried = new DataTransfer();
  for (const [name, text] of files) carried.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
  document.querySelector(selector).dispatchEvent(new DragEvent('drop', {dataTransfer: carried, bubbles: true, cancelable: true}));
}"""


def gsbake(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    command = python_command("-m", "gsbake", *map(str, words))
    return subprocess.run(command, env=python_environment(), capture_output=True, text=True, check=True, timeout=RUN_SECONDS, **options)


@contextmanager
def server(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The studio as a process, and its address."""
    command = python_command("-m", "gsbake", "studio", str(folder), "--no-browser")
    child = subprocess.Popen(command, env=python_environment(), stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    try:
        yield child, child.stdout.readline().split()[1]
    finally:
        child.terminate()
        child.wait(30)
        child.stdout.close()


class Session:
    """A page that may ask nobody else, and has no errors."""

    def __init__(self, page: Any) -> None:
        self.page, self.requests = page, 0
        self.errors: list[str] = []
        self.foreign: list[str] = []
        page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", self._note)
        self.pictures = Path(os.environ["GSBAKE_STUDIO_PICTURES"]) if "GSBAKE_STUDIO_PICTURES" in os.environ else None

    def _note(self, request: Any) -> None:
        self.requests += 1
        if not re.match(r"http://127\.0\.0\.1:\d+/|data:|blob:", request.url):
            self.foreign.append(request.url)

    def open(self, address: str) -> None:
        start = time.monotonic()
        self.page.goto(address)
        self.page.wait_for_selector("h1")
        self.seconds = time.monotonic() - start

    def tab(self, number: int) -> None:
        self.page.mouse.move(640, 30)
        self.page.evaluate("document.activeElement?.blur()")
        self.page.keyboard.press(str(number))

    def wait(self, expression: str, seconds: float = 60) -> None:
        """Ask until it holds; Playwright's own function needs `eval`, which the page's policy forbids."""
        deadline = time.monotonic() + seconds
        while not self.page.evaluate(f"() => Boolean({expression})"):
            assert time.monotonic() < deadline, expression
            self.page.wait_for_timeout(100)

    def text(self, selector: str) -> str:
        return str(self.page.inner_text(selector))

    def command(self, selector: str) -> str:
        """The command that a button shows."""
        self.page.hover(selector)
        return self.text("#command code")

    def picture(self, name: str) -> None:
        """Keep a picture of the page, small enough for the guide."""
        if self.pictures is not None:
            self.page.wait_for_timeout(400)
            pixels = cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            assert pixels is not None
            self.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(self.pictures / f"studio-{name}.webp"), pixels, [cv2.IMWRITE_WEBP_QUALITY, 72])

    def run_to_the_end(self) -> None:
        self.wait("document.getElementById('end').textContent && !document.getElementById('stop')", RUN_SECONDS)
        assert self.text("#end") == "Done", self.text("#end")


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    for module in MODULES:
        pytest.importorskip(module, reason="the extra `studio` is not installed")
    playwright = pytest.importorskip("playwright.sync_api")
    path = chromium()
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=FLAGS)
        yield browser.new_page(viewport=SIZE, accept_downloads=True)
        browser.close()


def on_canvas(session: Session, index: int, x: float, y: float, width: int, height: int) -> tuple[float, float]:
    """Where a pixel of a photo lies on the page, in a canvas that shows it whole."""
    canvas = session.page.locator(".pane canvas").nth(index)
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    scale = min(box["width"] / width, box["height"] / height)
    return (
        box["x"] + (box["width"] - scale * width) / 2 + scale * x,
        box["y"] + (box["height"] - scale * height) / 2 + scale * y,
    )


@pytest.mark.stress
@pytest.mark.timeout(3600)
def test_from_an_empty_folder_to_an_asset(page: Any, tmp_path: Path) -> None:
    folder, made = tmp_path / "captures", tmp_path / "made"
    folder.mkdir()
    gsbake("synth", made, "--views", 20, "--size", 160)
    photos = sorted((made / "images").iterdir())
    session = Session(page)
    with server(folder) as (_, address):
        session.open(address)
        assert session.seconds < 5 and "Nothing here yet" in page.inner_text("#view") and "token" not in page.url
        drop_photos(session, photos, folder)
        check_photos(session)
        (folder / "mug/transforms.json").write_bytes((made / "transforms.json").read_bytes())  # poses come by the file system
        draw_a_mask(session, folder)
        place_cameras(session, folder)
        set_up(session, folder)
        bake(session, folder)
        compare_and_download(session, folder)
    assert not session.foreign and not session.errors
    kill_the_server_in_a_run(page, folder)


def drop_photos(session: Session, photos: list[Path], folder: Path) -> None:
    files = [[path.name, base64.b64encode(path.read_bytes()).decode()] for path in photos]
    session.page.evaluate(DROP, [".drop", files])
    session.page.fill("form.inline input", "mug")
    session.page.press("form.inline input", "Enter")
    session.wait("document.querySelectorAll('.cell').length === 20")
    assert [path.read_bytes() for path in sorted((folder / "mug/images").iterdir())] == [path.read_bytes() for path in photos]
    session.wait("[...document.querySelectorAll('.cell img')].slice(0, 8).every((image) => image.naturalWidth > 0)")


def check_photos(session: Session) -> None:
    assert session.command("#check") == "gsbake check mug"
    session.page.click("#check")
    session.wait("document.querySelectorAll('.finding').length > 3", 300)
    session.page.locator(".cell").nth(3).focus()
    session.page.keyboard.press("x")
    session.wait("document.querySelectorAll('.cell.out').length === 1")
    session.picture("photos")
    session.page.keyboard.press("x")
    session.wait("document.querySelectorAll('.cell.out').length === 0")


def draw_a_mask(session: Session, folder: Path) -> None:
    page = session.page
    session.tab(2)
    page.wait_for_selector("[data-ready]")
    box = page.locator("canvas.picture").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = page.evaluate("document.querySelectorAll('.strip-item')[0].textContent")
    page.keyboard.press("e")
    for end in ((x - 60, y), (x + 60, y + 20)):  # taken away, and back by undo
        page.mouse.move(*end)
        page.mouse.down() if end[0] < x else page.mouse.up()
    page.keyboard.press("z")
    page.keyboard.press("s")
    page.mouse.move(x - 40, y)
    page.mouse.down()
    page.mouse.move(x + 40, y + 20, steps=6)
    page.mouse.up()
    session.wait("!document.querySelector('.work .state').textContent.includes('Loading')")
    page.keyboard.press("b")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 20, y, steps=4)
    page.mouse.up()
    session.picture("masks")
    page.keyboard.press("w")
    session.wait("[...document.querySelectorAll('.notice')].some((one) => one.textContent.startsWith('Written'))")
    mask = cv2.imread(str(folder / "mug/masks/000.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None and mask.shape == (160, 160) and mask[80, 80] == 255 and mask[2, 2] == 0 and "000.png" in before
    (folder / "mug/masks/000.png").unlink()  # the photos' own alpha channels are exact
    (folder / "mug/masks").rmdir()


def place_cameras(session: Session, folder: Path) -> None:
    page = session.page
    session.tab(4)
    page.wait_for_selector(".stages li")
    page.locator(".settings select").first.select_option("smoke")
    session.wait("document.querySelector('#command code').textContent.includes('--profile smoke')")
    session.tab(3)
    assert session.command("#find-cameras") == "gsbake poses --out out/mug"
    page.click("#find-cameras")
    page.wait_for_selector("#stop")
    session.run_to_the_end()
    assert json.loads((folder / "out/mug/project.json").read_text())["profile"] == "smoke"


def set_up(session: Session, folder: Path) -> None:
    page = session.page
    session.tab(3)
    page.wait_for_selector("#scene[data-ready]")
    page.click("#new-box")
    edges = page.locator("input[aria-label='Edges x']")
    before = float(edges.input_value())
    drag_a_handle(session)
    assert float(edges.input_value()) != before
    session.picture("setup")
    edges.fill(str(before))
    edges.blur()
    assert "poses.region_box=[" in session.command("#use-box")
    page.click("#use-box")
    box = stored(session, folder, "poses.region_box")
    assert len(json.loads(box)) == 15
    pick_the_ground(session)
    page.locator("select[aria-label='Front']").select_option("004.png")
    assert stored(session, folder, "export.front") == "004.png"
    page.locator("select[aria-label='Origin']").select_option("centre")
    assert stored(session, folder, "export.origin") == "centre"
    click_a_length(session, folder)


def stored(session: Session, folder: Path, key: str) -> str:
    """The value of a setting in the output folder, once it is there."""
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        for text in json.loads((folder / "out/mug/project.json").read_text())["overrides"]:
            if text.startswith(f"{key}="):
                return str(text.partition("=")[2])
        session.page.wait_for_timeout(100)
    raise AssertionError(f"{key} is not stored")


def drag_a_handle(session: Session) -> None:
    """Drag around the middle of the scene until a side moves."""
    page, edges = session.page, session.page.locator("input[aria-label='Edges x']")
    box = page.locator("#scene").bounding_box()
    before = edges.input_value()
    for dx in range(-280, 281, 20):
        for dy in range(-200, 201, 20):
            page.mouse.move(box["x"] + box["width"] / 2 + dx, box["y"] + box["height"] / 2 + dy)
            if page.evaluate("document.getElementById('scene').dataset.handle") == "x":
                page.mouse.down()
                page.mouse.move(box["x"] + box["width"] / 2 + 0.6 * dx, box["y"] + box["height"] / 2 + 0.6 * dy, steps=4)
                page.mouse.up()
                assert edges.input_value() != before
                return
    raise AssertionError("no handle was found")


def pick_the_ground(session: Session) -> None:
    """Click points until there are three."""
    page = session.page
    page.click("#up-ground")
    box = page.locator("#scene").bounding_box()
    for k in range(400):
        angle, reach = 2.4 * k, 8 * k**0.5
        page.mouse.click(box["x"] + box["width"] / 2 + reach * np.cos(angle), box["y"] + box["height"] / 2 + reach * np.sin(angle))
        if page.locator("#use-up").is_enabled():
            break
    assert "--up '" in session.command("#use-up")


def click_a_length(session: Session, folder: Path) -> None:
    """The same two points in two photos, where their cameras see them."""
    page = session.page
    (path,) = (folder / "out/mug/stages/poses").glob("*/photo_cameras.json")
    cameras = {camera.name: camera for camera in CameraSet.load(path).cameras}
    chosen = page.eval_on_selector_all(".pane select", "boxes => boxes.map((box) => box.selectedOptions[0].textContent)")
    session.wait("document.querySelectorAll('.pane canvas')[1].width > 300")
    page.wait_for_timeout(1500)
    for point in ((0.2, 0.0, 0.3), (-0.2, 0.1, 0.5)):
        for index, name in enumerate(chosen):
            camera = cameras[name.removesuffix(".png")]
            (u, v), _ = (values[0] for values in camera.project(np.array([point])))
            page.mouse.click(*on_canvas(session, index, u * 160 / camera.width, v * 160 / camera.height, 160, 160))
            page.wait_for_timeout(400)
    page.fill("input[aria-label='Length']", "9cm")
    assert "--known-distance" in session.command("#use-length")
    session.picture("scale")
    page.click("#use-length")
    assert "9cm" in stored(session, folder, "scale.known_distances")


def bake(session: Session, folder: Path) -> None:
    page = session.page
    session.tab(4)
    page.wait_for_selector("#run:not([disabled])")
    session.wait("document.querySelector('.run .bar .soft').textContent.includes('about')")
    assert session.command("#run") == "gsbake run --out out/mug"
    page.click("#run")
    page.wait_for_selector("#stop:not([disabled])")
    session.wait("document.querySelectorAll('.chart').length > 0 && !document.getElementById('live-picture').hidden", RUN_SECONDS)
    session.picture("run")
    session.run_to_the_end()
    assert (folder / "out/mug/asset.glb").is_file()


def compare_and_download(session: Session, folder: Path) -> None:
    page = session.page
    session.tab(5)
    session.wait("document.getElementById('compare-score')?.textContent.includes('PSNR')", 300)
    session.wait("document.querySelector('model-viewer').loaded", 120)
    page.wait_for_timeout(1000)
    session.picture("asset")
    score = float(session.text("#compare-score").split()[1])
    assert score > 15 and page.evaluate("document.getElementById('compare-render').naturalWidth") == 160
    page.check("#error-map")
    session.wait("document.getElementById('compare-render').src.endsWith('error.jpg')")
    page.locator("button[data-make=web]").scroll_into_view_if_needed()
    assert session.command("button[data-make=web]") == "gsbake targets --out out/mug --target web"
    page.click("button[data-make=web]")
    page.wait_for_selector("a[data-target=web]", timeout=1000 * RUN_SECONDS)
    session.picture("targets")
    with page.expect_download() as download:
        page.click("a[data-target=web]")
    assert Path(download.value.path()).read_bytes() == (folder / "out/mug/asset_web.glb").read_bytes()
    assert download.value.suggested_filename == "mug-asset_web.glb"
    session.tab(0)
    session.wait("document.querySelector('.state.done') && document.querySelector('.thumb img').naturalWidth > 0")
    page.keyboard.press("t")
    session.picture("captures")
    asked = session.requests
    page.wait_for_timeout(5000)
    assert session.requests == asked  # idle it asks nothing
    page.set_viewport_size({"width": 400, "height": 800})
    for number in range(6):
        if number:
            page.goto(re.sub(r"#.*", f"#/mug/{('photos', 'masks', 'setup', 'run', 'asset')[number - 1]}", page.url))
        page.wait_for_timeout(1500)
        wide = page.evaluate("[document.documentElement.scrollWidth, document.getElementById('view').scrollWidth]")
        assert max(wide) <= 400, (number, wide)
        if number == 1:
            session.picture("narrow")
    page.set_viewport_size(SIZE)


def wait_for_the_end(pid: int) -> None:
    """Wait until a process is gone, or is a zombie that nobody waits for."""
    deadline = time.monotonic() + 60
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.1)


def kill_the_server_in_a_run(page: Any, folder: Path) -> None:
    """The run goes on, `gsbake status` sees it, and so does the next server, which stops it and lets it go on."""
    session = Session(page)
    out = folder / "out/mug"
    with server(folder) as (child, address):
        session.open(address)
        page.goto(re.sub(r"[#?].*", "", page.url) + "#/mug/run")
        page.wait_for_selector("[data-key='train.iterations'] input")
        page.fill("[data-key='train.iterations'] input", "4000")
        page.press("[data-key='train.iterations'] input", "Enter")
        page.wait_for_selector("[data-key='train.iterations'].changed")
        page.click("#run:not([disabled])")
        session.wait("[...document.querySelectorAll('.stages .running')].length > 0", 300)
        child.kill()
        child.wait(30)
    live = json.loads((out / "live.json").read_text())
    assert psutil.pid_exists(live["pid"])
    status = json.loads(gsbake("status", "--out", out, "--json").stdout)
    assert status["running"]["pid"] == live["pid"]
    session = Session(page)
    with server(folder) as (_, address):
        session.open(address)
        page.goto(re.sub(r"[#?].*", "", page.url) + "#/mug/run")
        page.click("#stop:not([disabled])")
        session.wait("document.getElementById('end').textContent.includes('on request')", 300)
        wait_for_the_end(live["pid"])
        page.fill("[data-key='train.iterations'] input", "310")
        page.press("[data-key='train.iterations'] input", "Enter")
        page.click("#run:not([disabled])")
        page.wait_for_selector("#stop")
        session.run_to_the_end()
    assert not session.foreign
