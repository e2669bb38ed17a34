"""Pages in a headless Chromium, driven by puppeteer-core; a server on loopback gives it files.

Chromium comes from the system (Debian: `apt-get install chromium`, or $GSBAKE_CHROMIUM); tests that need it skip where it is missing.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
import pytest

from tests.support.node import run_node

#: Seconds that a page has to become ready.
TIMEOUT = 200
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
KINDS = {".js": "text/javascript", ".html": "text/html", ".wasm": "application/wasm", ".glb": "model/gltf-binary"}

VISIT = """
const puppeteer = require(process.argv[1] + '/puppeteer-core'), fs = require('fs');
const job = JSON.parse(fs.readFileSync(process.argv[2]));
(async () => {
  const browser = await puppeteer.launch({executablePath: job.chromium, headless: true, protocolTimeout: 240000, args: [
    '--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist', '--force-color-profile=srgb',
    '--disable-background-networking', '--no-first-run']});
  const out = {errors: [], requests: [], results: []};
  try {
    const page = await browser.newPage();
    await page.setViewport({width: job.width, height: job.height});
    page.on('console', m => { if (m.type() === 'error' || m.type() === 'warn') out.errors.push(m.type() + ': ' + m.text()); });
    page.on('pageerror', e => out.errors.push(String(e)));
    page.on('request', r => { if (!/^(data|blob):/.test(r.url())) out.requests.push(r.url()); });
    await page.goto(job.url, {waitUntil: 'load', timeout: 120000});
    for (const step of job.steps) {
      if (step.wait) await page.waitForFunction(step.wait, {timeout: job.timeout, polling: 200});
      if (step.key) await page.keyboard.press(step.key);
      if (step.evaluate) out.results.push(await page.evaluate(step.evaluate));
      if (step.screenshot) await page.screenshot({path: step.screenshot});
    }
  } catch (e) { out.errors.push('step failed: ' + e); } finally { await browser.close(); }
  console.log(JSON.stringify(out));
})().catch(e => { console.error(e); process.exit(1); });
"""


def chromium() -> str:
    """Path of the browser; the test is skipped without one."""
    found = os.environ.get("GSBAKE_CHROMIUM") or next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip("Chromium is not installed")
    return found


def visit(url: str, steps: list[dict[str, str]], folder: Any, size: tuple[int, int] = (900, 700)) -> dict[str, Any]:
    """Open a page and take the steps, each of `wait` (an expression), `key`, `evaluate` (an expression) and `screenshot` (a path).

    Returns `errors` and warnings of the console, `requests` beyond data inside the page, and `results` of the expressions.
    """
    job = folder / "visit.json"
    what = {"chromium": chromium(), "url": url, "steps": steps, "width": size[0], "height": size[1], "timeout": 1000 * TIMEOUT}
    job.write_text(json.dumps(what))
    found: dict[str, Any] = run_node(VISIT, "puppeteer-core", job)
    return found


@contextmanager
def served(files: Mapping[str, bytes]) -> Iterator[str]:
    """Address of a server on loopback with `files` by path."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = files.get(self.path.lstrip("/"))
            self.send_response(404 if content is None else 200)
            kind = next((kind for ending, kind in KINDS.items() if self.path.endswith(ending)), "application/octet-stream")
            self.send_header("Content-Type", kind)
            self.end_headers()
            self.wfile.write(content or b"")

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def picture(uri: str) -> np.ndarray:
    """Pixels (h, w, 4) 8-bit RGBA of a data URI."""
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3]])
