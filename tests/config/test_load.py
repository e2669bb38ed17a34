"""Profiles: what ships is valid, extends works, and each mistake gets its sentence."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from gsbake.config.load import DEFAULT, bounds, fields, load_profile, shipped
from gsbake.config.schema import Profile
from gsbake.errors import BadInputError, GsbakeError, UsageError


def write(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_shipped_profiles() -> None:
    assert set(shipped()) == {"smoke", "preview", "relight", "quality", "scan"}
    loaded = {name: load_profile(name).profile for name in shipped()}
    assert all(p.description for p in loaded.values())
    assert {name for name, p in loaded.items() if p.bake.materials == "fit"} == {"relight", "quality"}
    assert {name for name, p in loaded.items() if p.bake.materials == "delight"} == {"scan"}
    cost = [loaded[name].train.iterations for name in ("smoke", "preview", "relight", "quality")]
    assert cost == sorted(cost) and cost[0] < cost[1]
    assert load_profile().name == DEFAULT == "relight"


def test_every_setting_has_help() -> None:
    assert [key for key, field in fields().items() if not field.description] == []
    sections = [
        f.annotation for f in Profile.model_fields.values() if isinstance(f.annotation, type) and issubclass(f.annotation, BaseModel)
    ]
    assert sum(len(s.model_fields) for s in sections) == len([k for k in fields() if "." in k])


def test_extends_origins_and_overrides(tmp_path: Path) -> None:
    write(tmp_path / "base.toml", 'extends = "preview"\n[mesh]\nfaces = 777\nsmoothing_iterations = 1\n')
    mine = write(tmp_path / "mine.toml", 'extends = "base.toml"\n[mesh]\nfaces = 888\n')
    loaded = load_profile(mine, ["bake.size=512", "mesh.holes=leave", "export.copyright=2031 me = you", "skip.converged_steps=never"])
    profile, preview = loaded.profile, load_profile("preview").profile
    assert (profile.mesh.faces, profile.mesh.smoothing_iterations, profile.bake.size) == (888, 1, 512)
    assert profile.mesh.holes == "leave" and profile.export.copyright == "2031 me = you" and profile.skip.converged_steps == "never"
    assert profile.train.iterations == preview.train.iterations
    origins = loaded.origins
    assert origins["mesh.faces"] == mine and origins["mesh.smoothing_iterations"] == str(tmp_path / "base.toml")
    assert origins["train.iterations"] == "preview" and origins["bake.size"] == "--set" and origins["export.max_triangles"] == "default"
    assert load_profile(mine.removesuffix(".toml")).profile.mesh.faces == 888


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[train]\niteration = 5\n", ["there is no setting 'train.iteration'", "the nearest is 'train.iterations'"]),
        ("[trian]\niterations = 5\n", ["'trian.iterations'", "the nearest is 'train.iterations'"]),
        ('[skip]\nredundant_photos = "sometimes"\n', ["skip.redundant_photos = 'sometimes'", "one of auto, always, never"]),
        ("[bake]\nfaces = 5\n", ["'bake.faces'", "the nearest is 'mesh.faces'"]),
        ("faces = 5\n", ["'faces'", "the nearest is 'mesh.faces'"]),
        ("[mesh]\nfaces = 5\n", ["mesh.faces = 5 is invalid: it must be ≥ 100"]),
        ("[bake]\nsize = 1000\n", ["bake.size = 1000", "one of 128, 256"]),
        ('[mesh]\nholes = "leaves"\n', ["mesh.holes = 'leaves'", "one of close, leave", "did you mean 'leave'?"]),
        ('[ingest]\ninvert_masks = "perhaps"\n', ["ingest.invert_masks", "must be true or false"]),
        ('[train]\niterations = "many"\n', ["train.iterations = 'many'"]),
        ('train = "fast"\n', ["'train'"]),
        ("[train\n", ["is not valid TOML", "line 1"]),
        ('extends = "previw"\n', ['extends = "previw" names no profile', "did you mean 'preview'?"]),
        ("extends = 3\n", ["'extends' must be the name of a profile"]),
        ('extends = "mine.toml"\n', ["goes round in a circle"]),
    ],
)
def test_mistakes_in_a_file(tmp_path: Path, text: str, says: list[str]) -> None:
    mine = write(tmp_path / "mine.toml", text)
    with pytest.raises(BadInputError) as caught:
        load_profile(mine)
    message = str(caught.value)
    assert mine in message and "\n" not in message and caught.value.exit_code == 42
    for part in says:
        assert part in message


@pytest.mark.parametrize(
    ("override", "error", "says"),
    [
        ("train.iteration=5", BadInputError, "--set: there is no setting 'train.iteration'; the nearest is 'train.iterations'."),
        ("loss.ssim=2", BadInputError, "--set: loss.ssim = 2 is invalid: it must be ≥ 0, ≤ 1."),
        ("train.iterations", UsageError, "--set takes section.key=value, not 'train.iterations'."),
    ],
)
def test_mistakes_in_overrides(override: str, error: type[GsbakeError], says: str) -> None:
    with pytest.raises(error) as caught:
        load_profile("smoke", [override])
    assert str(caught.value) == says


def test_unknown_profile() -> None:
    with pytest.raises(UsageError, match="There is no profile 'relihgt': did you mean 'relight'?"):
        load_profile("relihgt")
    with pytest.raises(UsageError, match="there are preview, quality, relight, scan, smoke"):
        load_profile("/no/such.toml")


def test_bounds_in_words() -> None:
    known = fields()
    assert bounds(known["train.iterations"]) == "≥ 0, ≤ 10000000" and bounds(known["mesh.holes"]) == "one of close, leave"
    assert bounds(known["ingest.invert_masks"]) == "" and bounds(known["poses.source"]) == "one of auto, given, solve"
