"""The report in headless Chromium: drawn, without an error or a request, by mouse and by keyboard."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsbake.imaging.exr import write_exr
from tests.report.conftest import Finished
from tests.support.browser import chromium, picture, visit

LOADED = "document.querySelector('model-viewer').loaded && document.querySelector('model-viewer').modelIsVisible"
DRAWN = "new Promise(done => setTimeout(() => done(document.querySelector('model-viewer').toDataURL()), 6000))"
SLIDER = "document.querySelector('.compare input')"
#: What model-viewer itself says on every page.
ITS_OWN = ("RGBELoader has been deprecated", "rAF timed out")


@pytest.mark.slow
def test_the_page_in_a_browser(make_run: Callable[..., Finished], tmp_path: Path) -> None:
    chromium()
    done = make_run(materials=True)
    coverage = np.ones((64, 64, 3), np.float32)
    coverage[48:, :, 1] = 0
    write_exr(done.folders["bake"] / "coverage.exr", coverage)
    done.report()
    page = done.out / "report.html"
    assert page.stat().st_size < 8e6
    shown = f"getComputedStyle({SLIDER}.parentElement).getPropertyValue('--at')"
    steps = [
        {"evaluate": "document.querySelector('model-viewer').scrollIntoView()"}, {"wait": LOADED}, {"evaluate": DRAWN},
        {"evaluate": shown}, {"evaluate": f"{SLIDER}.focus()"}, {"key": "ArrowRight"}, {"key": "ArrowRight"}, {"evaluate": shown},
        {"evaluate": "document.getElementById('map').dataset.drawn"}, {"evaluate": "document.getElementById('map').focus()"},
        {"key": "ArrowLeft"}, {"evaluate": "document.getElementById('map').dataset.drawn"},
        {"evaluate": "document.documentElement.dataset.theme = 'dark'; getComputedStyle(document.body).backgroundColor"},
        # The viewer draws only while it is in sight, and the focus has moved on.
        {"evaluate": "document.querySelector('model-viewer').scrollIntoView()"},
        {"evaluate": "document.querySelector('[data-view=wire]').click()"}, {"evaluate": DRAWN},
        {"evaluate": "document.querySelector('[data-view=base-colour]').click()"}, {"evaluate": DRAWN},
        {"evaluate": "[...document.images].filter(image => !image.closest('dialog') && image.naturalWidth === 0).length"},
    ]  # fmt: skip
    found = visit(page.as_uri(), steps, tmp_path)
    assert len(found["results"]) == 15, found["errors"]
    assert [e for e in found["errors"] if not any(known in e for known in ITS_OWN)] == []
    assert found["requests"] == [page.as_uri()]
    _, shaded, before, _, after, first, _, second, dark, _, _, wire, _, flat, missing = found["results"]
    images = {name: picture(uri) for name, uri in (("shaded", shaded), ("wire", wire), ("flat", flat))}
    covered = {name: float((image[..., 3] > 220).mean()) for name, image in images.items()}
    assert covered["shaded"] > 0.1 and covered["flat"] == pytest.approx(covered["shaded"], rel=0.1)  # the shadow below is paler
    assert 0.005 < covered["wire"] < covered["shaded"]
    ball = images["flat"][images["flat"][..., 3] > 250][:, :3]
    assert abs(float(ball.mean()) - 188) < 12 and ball.std() < 8  # the base colour of the grey ball, without shading
    assert (before.strip(), after.strip()) == ("50%", "51%")
    assert int(second) > int(first) >= 1 and missing == 0
    assert dark == "rgb(19, 20, 22)"
