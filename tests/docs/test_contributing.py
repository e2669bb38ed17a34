"""The examples of CONTRIBUTING.md run."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from pydantic import Field
from torch import Tensor

import gsbake.api
from gsbake.config import schema
from gsbake.config.load import load_profile
from gsbake.pipeline.registry import Registry
from gsbake.stages import ORDER, REGISTRY

ROOT = Path(__file__).resolve().parents[2]


def blocks(section: str, language: str) -> dict[str, str]:
    """{what the first line's comment names: code} of the fenced blocks below the heading `section`."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split(f"## {section}\n")[1].split("\n## ")[0]
    found = re.findall(rf"```{language}\n# (\S+)\n(.*?)```", text, re.S)
    assert found, section
    return dict(found)


def run_tests(names: dict[str, Any]) -> None:
    tests: list[Callable[[], None]] = [value for name, value in names.items() if name.startswith("test_")]
    assert tests
    for test in tests:
        test()


def test_add_a_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = blocks("Add a stage", "python")["stages/card.py"]
    (tmp_path / "contributed_card.py").write_text(code)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    toys = {name: f"tests.docs.toy_stages:{name.upper()}" for name in ORDER}
    monkeypatch.setattr(gsbake.api, "REGISTRY", Registry(toys | {"card": "contributed_card:STAGE"}))
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in "abc":
        (photos / f"{name}.png").write_text(name)
    result = gsbake.api.run(photos, out=tmp_path / "out", settings={"export.copyright": "CC0"}, until="card")
    card = next((tmp_path / "out" / "stages" / "card").glob("*/card.json"))
    size = (tmp_path / "out" / "asset.glb").stat().st_size
    assert json.loads(card.read_text()) == {"bytes": size, "copyright": "CC0"} and result.results("card") == {"bytes": size}


def test_the_places_a_stage_is_named_in_exist() -> None:
    from gsbake.cli.app import STAGE_HELP

    assert set(STAGE_HELP) == set(ORDER) == set(REGISTRY.names)


def test_add_a_loss() -> None:
    code = blocks("Add a loss", "python")
    names: dict[str, Any] = {"Section": schema.Section, "Field": Field}
    exec(code["gsbake/surfels/losses/terms.py"], names)
    exec(code["tests/surfels/losses/test_anisotropy.py"], names)
    run_tests(names)
    exec(code["gsbake/config/schema.py"], names)
    assert names["Loss"]().anisotropy == 0
    scale = torch.tensor([[3.0, 0.0]])
    step: dict[str, Any] = {
        "w": names["Loss"](anisotropy=2.0), "s": SimpleNamespace(log_scale=scale), "losses": SimpleNamespace(**names),
        "total": torch.zeros(()),
    }  # fmt: skip
    exec(code["gsbake/surfels/training/"], step)
    assert float(step["total"]) == pytest.approx(2 * (3 - math.log(10)))
    for stage in ("train", "refine"):
        assert "loss.*" in REGISTRY.load(stage).settings


def test_add_a_profile(tmp_path: Path) -> None:
    code = blocks("Add a profile", "toml")["profiles/web.toml"]
    (tmp_path / "web.toml").write_text(code)
    profile = load_profile(str(tmp_path / "web.toml")).profile
    assert profile.mesh.faces == 10000 and profile.bake.materials == "fit"


def test_add_a_field(monkeypatch: pytest.MonkeyPatch) -> None:
    from collections.abc import Mapping

    from gsbake.surfels.fields import registry
    from gsbake.surfels.fields.known import Known
    from gsbake.surfels.initialisation import fibonacci_sphere, spacing
    from gsbake.surfels.model import create

    monkeypatch.setattr(registry, "FIELDS", dict(registry.FIELDS))
    settings = schema.DistanceField().model_copy(update={"kind": "ball"})
    profile = SimpleNamespace(field=settings, coupling=schema.Coupling(), loss=schema.Loss(), train=schema.Train())
    code = blocks("Add a field", "python")
    names: dict[str, Any] = {
        "torch": torch, "Tensor": Tensor, "Known": Known, "Mapping": Mapping, "FIELDS": registry.FIELDS, "create": create,
        "spacing": spacing, "fibonacci_sphere": fibonacci_sphere, "make_field": registry.make_field, "profile": profile,
    }  # fmt: skip
    exec(code["gsbake/surfels/fields/ball.py"], names)
    exec(code["gsbake/surfels/fields/registry.py"], names)
    exec(code["tests/surfels/fields/test_ball.py"], names)
    run_tests(names)


def test_add_a_coupling() -> None:
    code = blocks("Add a coupling", "python")
    names: dict[str, Any] = {"Tensor": Tensor, "CouplingInputs": object}
    exec(code["gsbake/surfels/couplings/attachment.py"], names)
    inputs = SimpleNamespace(visible=torch.tensor([0.5, 0.5]), at_surfels=(torch.tensor([-1.0, 3.0]), torch.zeros(2, 3)))
    assert float(names["outside"](inputs)) == 0.5


def test_add_a_densification_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    from gsbake.surfels.densification import registry

    monkeypatch.setattr(registry, "DENSIFICATION", dict(registry.DENSIFICATION))
    code = blocks("Add a densification policy", "python")
    names: dict[str, Any] = {"Tensor": Tensor, "torch": torch, "DENSIFICATION": registry.DENSIFICATION}
    exec(code["gsbake/surfels/densification/opaque.py"], names)
    names["opaque"] = SimpleNamespace(score=names["score"])
    exec(code["gsbake/surfels/densification/registry.py"], names)
    exec(code["tests/surfels/densification/test_opaque.py"], names)
    run_tests(names)
