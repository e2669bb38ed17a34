"""The ablation of the material fit: every rule can be taken out, and the table has what each brings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import ablation
from benchmarks.ablation import RULES, SETTINGS, Row, markdown
from benchmarks.csv_rows import read_rows, write_rows
from gsbake.config.load import load_profile
from gsbake.errors import UsageError
from gsbake.materials.bake import BakeOptions
from gsbake.materials.recipe import OPTIONAL

ROW = Row("toy", "none", 0, "abc1234", "cpu", 60.0, 25.0, 26.0, 23.0, 24.0, 0.1, 0.2)


@pytest.mark.parametrize("rule", [rule for rule in RULES if rule != "none"])
def test_rules_are_passes_or_settings(rule: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pass that is renamed is found here; settings are valid."""
    load_profile("relight", [SETTINGS[rule]] if rule in SETTINGS else [])
    assert (rule in SETTINGS) != (rule in OPTIONAL)
    given: list[BakeOptions] = []
    monkeypatch.setattr(
        ablation, "finished_folders", lambda run: {stage: tmp_path for stage in ("ingest", "poses", "refine", "mesh", "bake")}
    )
    (tmp_path / "manifest.json").write_text('{"settings": {}}')
    monkeypatch.setattr(ablation, "bake_textures", lambda *paths, seed: given.append(paths[-1]))
    monkeypatch.setattr(ablation, "export_asset", lambda *_: None)
    ablation.bake_without(rule, tmp_path, tmp_path / "out", 0)
    assert given[0].without == ({rule} if rule in OPTIONAL else set())


def test_a_rule_is_judged_on_the_objects_that_it_changes(tmp_path: Path) -> None:
    rows = [ROW, replace(ROW, object="stool"), replace(ROW, object="steel")]
    rows += [replace(ROW, rule="emission", relit=24.0, seconds=50.0), replace(ROW, rule="emission", object="stool", relit=25.5, base=22.0)]
    rows += [replace(ROW, rule="emission", object="steel"), replace(ROW, rule="sparsity")]
    write_rows(tmp_path / "rows.csv", [*rows, rows[0]])
    assert read_rows(tmp_path / "rows.csv", Row) == rows
    lines = markdown(rows).splitlines()
    assert lines[2] == "| emission | 2 of 3 | +0.2 (+0.0) | -0.5 stool | +0.5 (+0.0) | +0.0 toy | +0.000 | +5 |"
    assert lines[3] == "| sparsity | 0 of 1 | – | – | – | – | – | – |"


def test_unfinished_runs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no finished stage ingest"):
        ablation.bake_without("none", tmp_path, tmp_path / "out", 0)


def test_what_a_stopped_run_left_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A texture that the new bake does not write would be exported with it."""
    out, folders = tmp_path / "out", {stage: tmp_path / stage for stage in ("ingest", "poses", "refine", "mesh", "bake")}
    folders["bake"].mkdir()
    (folders["bake"] / "manifest.json").write_text('{"settings": {}}')
    (out / "baked").mkdir(parents=True)
    (out / "baked" / "emissive.exr").touch()
    monkeypatch.setattr(ablation, "finished_folders", lambda run: folders)
    monkeypatch.setattr(ablation, "bake_textures", lambda *_, **__: None)
    monkeypatch.setattr(ablation, "export_asset", lambda *_: (out / "previews").mkdir())
    ablation.bake_without("none", tmp_path, out, 0)
    assert sorted(path.name for path in out.rglob("*")) == ["baked", "previews"]
