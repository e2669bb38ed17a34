"""What `gsbake check` says about photos with known faults."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.capture.check import Finding, check_photos, coverage
from gsbake.cli import main
from gsbake.errors import BadInputError
from tests.capture.test_poses import board_capture, transforms
from tests.support.cameras import look_at


def of(findings: list[Finding], about: str) -> Finding:
    return next(finding for finding in findings if finding.about == about)


def ring(count: int, sector: float = 360.0, heights: tuple[float, ...] = (0.5,)) -> list[Any]:
    """Cameras around the origin over `sector` degrees, one round per height."""
    turns = np.radians(np.linspace(0, sector, count, endpoint=sector < 360))
    places = [(3 * np.cos(a), 3 * np.sin(a), height) for height in heights for a in turns]
    return [look_at(place, name=f"c{i:02}") for i, place in enumerate(places)]


def test_a_missing_side_is_named() -> None:
    findings = coverage(ring(20, 270.0))
    assert of(findings, "sides").level == "advice"
    assert "a sector of 90°, between c19 and c00" in of(findings, "sides").text
    assert of(coverage(ring(20)), "sides") == Finding("good", "sides", "photos look from all sides, at most 18° apart")


def test_one_height_is_named() -> None:
    assert "from one height (9° to 10° above" in of(coverage(ring(20)), "heights").text
    assert of(coverage(ring(20, heights=(0.3, 2.5))), "heights").level == "good"


def test_faults_of_photos(tmp_path: Path) -> None:
    """A board on an arc: few photos, one of them blurred, one overexposed, one broken."""
    cameras = board_capture(tmp_path / "cap")
    transforms(tmp_path / "cap", cameras)
    images = tmp_path / "cap/images"
    for name, blur, gain in (("b3", 6.0, 1.0), ("b6", 0.1, 4.0)):
        photo: Any = cv2.imread(str(images / f"{name}.png"))
        changed = np.minimum(cv2.GaussianBlur(photo, (0, 0), blur) * gain, 255).astype(np.uint8)
        cv2.imwrite(str(images / f"{name}.png"), changed)
    (images / "b9.png").write_bytes(b"broken")
    (tmp_path / "work").mkdir()
    findings, figures = check_photos(images, tmp_path / "work", poses=tmp_path / "cap/transforms.json")
    assert of(findings, "number of photos").level == "problem" and findings[0].level == "problem"
    assert "b9.png" in of(findings, "files").text
    assert of(findings, "sharpness").text == "1 photo much more blurred than the rest: b3.png"
    assert of(findings, "exposure").level == "advice"
    assert of(findings, "cameras").text == "8 of 8 photos have a given pose"
    assert of(findings, "sides").level == "advice" and figures["registered"] == 8


@pytest.mark.slow
def test_photos_that_do_not_register(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    rng = np.random.default_rng(0)
    for i in range(13):
        cv2.imwrite(str(images / f"{i}.png"), cv2.GaussianBlur(rng.integers(0, 255, (96, 128, 3), np.uint8), (0, 0), 9))
    (tmp_path / "work").mkdir()
    findings, _ = check_photos(images, tmp_path / "work")
    assert of(findings, "cameras").level == "problem" and "registered only 0 of 13" in of(findings, "cameras").text
    assert of(findings, "number of photos").text == "13 photos are few"
    (tmp_path / "again").mkdir()
    for i in range(2, 13):
        (images / f"{i}.png").unlink()
    with pytest.raises(BadInputError, match="2 usable photos"):
        check_photos(images, tmp_path / "again")


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = board_capture(tmp_path / "cap", 4)
    transforms(tmp_path / "cap", cameras)
    for arguments in (["--json"], []):
        monkeypatch.setattr(sys, "argv", ["gsbake", "check", str(tmp_path / "cap"), "--threads", "1", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert not ended.value.code
        printed = capsys.readouterr().out
        if arguments:
            document = json.loads(printed)
            assert {"level", "about", "text", "do"} == set(document["findings"][0]) and document["figures"]["registered"] == 4
        else:
            assert printed.startswith("✗ number of photos") and "1 problem, " in printed
