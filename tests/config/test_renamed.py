"""Old names of values are taken for one version: with one line that names the new one, and with the same cache keys."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import gsbake
import gsbake.api
from gsbake.config.load import load_profile
from gsbake.config.renamed import RENAMED, present_override
from gsbake.config.schema import Profile
from gsbake.errors import BadInputError, RenamedValueWarning
from gsbake.pipeline.settings import flatten
from gsbake.pipeline.store import Store
from tests.cli import toy_bake


def test_old_values_of_skip_mean_what_they_meant(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('[skip]\nspecular = "always"\n')
    with pytest.warns(RenamedValueWarning) as caught:
        old = load_profile(str(mine), ["skip.empty_cells=never"])
    assert [str(w.message) for w in caught] == [
        f'{mine}: skip.specular = "always" is now "skip"; the next version takes the new value alone.',
        '--set: skip.empty_cells = "never" is now "keep"; the next version takes the new value alone.',
    ]
    mine.write_text('[skip]\nspecular = "skip"\n')
    new = load_profile(str(mine), ["skip.empty_cells=keep"])
    assert flatten(old.profile) == flatten(new.profile) and new.profile.skip.specular == "skip"


def test_other_settings_keep_always_and_never() -> None:
    assert RENAMED.keys() == {"skip"}
    for value in ("always", "never"):  # a warning is an error here
        assert load_profile("relight", [f"stereo.enabled={value}"]).profile.stereo.enabled == value
    with pytest.raises(BadInputError, match="stereo.enabled = 'keep' is invalid: it must be one of auto, always, never"):
        load_profile("relight", ["stereo.enabled=keep"])


def test_rules_are_auto_unless_a_profile_says_otherwise() -> None:
    """Values at their default do not enter keys: a rule that nobody set changes none."""
    assert set(Profile().skip.model_dump().values()) == {"auto"}


@pytest.mark.parametrize(
    ("text", "now"),
    [
        ("skip.specular=always", "skip.specular=skip"),
        (' skip.specular = "never" ', "skip.specular=keep"),
        ("skip.specular=auto", "skip.specular=auto"),
        ("stereo.enabled=never", "stereo.enabled=never"),
        ("export.copyright=never", "export.copyright=never"),
    ],
)
def test_override_with_the_present_name(text: str, now: str) -> None:
    assert present_override(text) == now


def test_the_output_folder_remembers_the_present_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.REGISTRY)
    (tmp_path / "photos").mkdir()
    for name in "abc":
        (tmp_path / "photos" / f"{name}.jpg").write_text(name)
    with pytest.warns(RenamedValueWarning):
        gsbake.run(tmp_path / "photos", out=tmp_path / "o", settings={"skip.specular": "never"})
    assert json.loads((tmp_path / "o" / "project.json").read_text())["overrides"] == ["skip.specular=keep"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = gsbake.run(out=tmp_path / "o")
    assert {state.status for state in again.stages} == {"cached"} and len(Store(tmp_path / "o").manifests("ingest")) == 1


def test_the_command_line_says_it_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('[skip]\nspecular = "never"\n')
    command = [sys.executable, "-m", "gsbake", "profiles", "mine.toml", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and json.loads(done.stdout)["skip.specular"]["value"] == "keep"
    said = 'gsbake: warning: mine.toml: skip.specular = "never" is now "keep"; the next version takes the new value alone.\n'
    assert done.stderr == said
