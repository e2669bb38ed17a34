"""The examples of the Python page run, one after the other: runs over toy stages, functions of stages on a small built-in capture."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import gsbake.api
from tests.docs import toy_stages

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "python.md"


def examples() -> list[str]:
    return re.findall(r"(?m)^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.S | re.M)


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_stages.REGISTRY)
    Path("photos").mkdir()
    for name in "abc":
        cv2.imwrite(f"photos/{name}.png", np.full((8, 8, 3), 40, np.uint8))
    names: dict[str, Any] = {}
    printed = []
    for code in examples():
        exec(code, names)
        printed.append(capsys.readouterr().out.strip())
    baked, again, refused, planned, observed, staged = printed
    assert baked == "out/tankard/asset.glb ()"
    assert again == "['export']"
    assert refused == "'out/nowhere' holds no run yet: give the folder of photos the first time. 2"
    assert planned == "['mesh', 'bake', 'export', 'report']"
    assert staged == "8 given"
    assert observed == ""  # toy stages decide nothing


def test_every_stage_and_the_api_are_on_the_page() -> None:
    """What `stages/` calls, and what `gsbake` itself offers."""
    text = PAGE.read_text(encoding="utf-8")
    listed = set(re.findall(r"(?m)^::: (\S+)$", text))
    assert {"gsbake.api.run", "gsbake.api.Result", "gsbake.api.open_session", "gsbake.api.Session"} <= listed
    for stage in sorted((PAGE.parents[2] / "stages").glob("[a-z]*.py")):
        called = re.findall(r"(?m)^    return (\w+)\(", stage.read_text(encoding="utf-8"))
        assert len(called) == 1 and any(name.endswith(f".{called[0]}") for name in listed), stage
