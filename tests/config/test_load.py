"""Loading of profiles: shipped profiles, `extends`, overrides, ranges and error messages."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import pytest
from pydantic import BaseModel

from gsbake.config.load import DEFAULT, bounds, fields, load_profile, shipped
from gsbake.config.schema import Profile
from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.stages import REGISTRY

Condition = Callable[[Profile], bool]


def fits_materials(p: Profile) -> bool:
    return p.bake.materials == "fit"


def trains_materials(p: Profile) -> bool:
    return p.surfels.shading == "pbr"


#: Settings that are read under a condition only.
CONDITIONS: dict[str, Condition] = {
    "stereo.[!e]*": lambda p: p.stereo.enabled != "never",
    "surfels.sh_degree": lambda p: not trains_materials(p),
    "light.size": lambda p: trains_materials(p) or p.bake.materials in ("fit", "delight"),
    "train.lr_light": trains_materials,
    "loss.smoothness": trains_materials,
    "loss.neutral_light": trains_materials,
    "refine.prune_distance": lambda p: p.refine.prune == "sdf",
    "mesh.max_resolution": lambda p: p.mesh.resolution == 0,
    "bake.fit_*": fits_materials,
    "bake.smoothness": fits_materials,
    "bake.*_l1": fits_materials,
    "bake.neutral_light": fits_materials,
    "bake.sparsity": fits_materials,
    "bake.visibility": lambda p: p.bake.materials in ("fit", "delight"),
    "bake.default_roughness": lambda p: p.bake.materials in ("none", "delight"),
}


#: Profiles of published systems.
SYSTEMS = {
    "dsdf", "gs-ror2", "3dgsr", "gsdf", "gs-octree", "gs-pull", "surfacesplat", "splatsdf", "gaussianroom", "ugsdf", "sdf-3dgan", "neus",
    "volsdf",
}  # fmt: skip


def write(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_shipped_profiles() -> None:
    assert set(shipped()) == {"smoke", "preview", "relight", "quality", "scan"} | SYSTEMS
    loaded = {name: load_profile(name).profile for name in shipped()}
    assert all(p.description for p in loaded.values())
    assert {name for name, p in loaded.items() if p.bake.materials == "fit"} == {"relight", "quality"} | SYSTEMS
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


@pytest.mark.parametrize("name", sorted(shipped()))
def test_a_shipped_profile_sets_only_what_a_stage_reads(name: str) -> None:
    body = tomllib.loads(shipped()[name].read_text())
    profile = load_profile(name).profile
    declared = [pattern for stage in REGISTRY.names for pattern in REGISTRY.load(stage).settings]
    keys = [f"{section}.{key}" for section, values in body.items() if isinstance(values, dict) for key in values]
    assert keys and all(any(fnmatch(key, pattern) for pattern in declared) for key in keys)
    unread = [key for key in keys for pattern, read in CONDITIONS.items() if fnmatch(key, pattern) and not read(profile)]
    assert unread == []


def test_conditions_name_settings() -> None:
    assert all(any(fnmatch(key, pattern) for key in fields()) for pattern in CONDITIONS)


def test_every_number_is_finite_and_bounded() -> None:
    numbers = {key: field for key, field in fields().items() if field.annotation in (int, float)}
    assert len(numbers) > 40
    for key, field in numbers.items():
        limits = {name for m in field.metadata for name in ("ge", "gt", "le", "lt") if getattr(m, name, None) is not None}
        assert limits in ({"ge", "le"}, {"gt", "le"}), key
        for value in ("inf", "-inf", "nan", "1e26", "-1", "text"):
            with pytest.raises(BadInputError, match=rf"--set: {key} = .* is (invalid|not a number): it must be a (whole )?number "):
                load_profile("smoke", [f"{key}={value}"])


def test_extends_origins_and_overrides(tmp_path: Path) -> None:
    write(tmp_path / "base.toml", 'extends = "preview"\n[mesh]\nfaces = 777\nsmoothing_iterations = 1\n')
    mine = write(tmp_path / "mine.toml", 'extends = "base.toml"\n[mesh]\nfaces = 888\n')
    loaded = load_profile(mine, ["bake.size=512", "mesh.holes=leave", "export.copyright=2031 me = you", "skip.converged_steps=keep"])
    profile, preview = loaded.profile, load_profile("preview").profile
    assert (profile.mesh.faces, profile.mesh.smoothing_iterations, profile.bake.size) == (888, 1, 512)
    assert profile.mesh.holes == "leave" and profile.export.copyright == "2031 me = you" and profile.skip.converged_steps == "keep"
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
        ('[skip]\nredundant_photos = "sometimes"\n', ["skip.redundant_photos = 'sometimes'", "one of auto, skip, keep"]),
        ("[bake]\nfaces = 5\n", ["'bake.faces'", "the nearest is 'mesh.faces'"]),
        ("faces = 5\n", ["'faces'", "the nearest is 'mesh.faces'"]),
        ("[mesh]\nfaces = 5\n", ["mesh.faces = 5 is invalid: it must be a whole number from 100 to 10 000 000."]),
        ("[bake]\nsize = 1000\n", ["bake.size = 1000", "one of auto, 128, 256"]),
        ('[mesh]\nholes = "leaves"\n', ["mesh.holes = 'leaves'", "one of close, leave", "did you mean 'leave'?"]),
        ('[ingest]\ninvert_masks = "perhaps"\n', ["ingest.invert_masks", "must be true or false"]),
        ('[train]\niterations = "many"\n', ["train.iterations = 'many' is not a number: it must be a whole number from 0 to 10 000 000."]),
        ('train = "fast"\n', ["'train'"]),
        ("[train\n", ["is not valid TOML", "line 1"]),
        ('extends = "previw"\n', ['extends = "previw" names no profile', "did you mean 'preview'?"]),
        ("extends = 3\n", ["'extends' must be the name of a profile"]),
        ('extends = "mine.toml"\n', ["forms a cycle through mine.toml"]),
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
        ("loss.ssim=2", BadInputError, "--set: loss.ssim = 2 is invalid: it must be a number from 0 to 1."),
        ("loss.mask=inf", BadInputError, "--set: loss.mask = inf is invalid: it must be a number from 0 to 10 000."),
        ("train.lr_sdf=0", BadInputError, "--set: train.lr_sdf = 0 is invalid: it must be a number above 0, up to 1."),
        ("loss.mask=1e26", BadInputError, "--set: loss.mask = 1e+26 is invalid: it must be a number from 0 to 10 000."),
        ("report.views=1e26", BadInputError, "--set: report.views = 1e+26 is invalid: it must be a whole number from 1 to 24."),
        ("mesh.faces=abc", BadInputError, "--set: mesh.faces = 'abc' is not a number: it must be a whole number from 100 to 10 000 000."),
        ("poses.fine_features=on?", BadInputError, "--set: poses.fine_features = 'on?' is invalid: it must be one of true, false, auto."),
        ("poses.region_box=[nan]", BadInputError, "--set: poses.region_box = nan is invalid: it must be a list of at most 15 numbers."),
        (
            "poses.region_box=[1,2,3]",
            BadInputError,
            "--set: poses.region_box = [1, 2, 3] is invalid: it must be empty, or 15 numbers: a centre, three positive edges and a "
            "rotation by rows, as --region sets them.",
        ),
        ("targets.files=7", BadInputError, "--set: targets.files = 7 is invalid: it must be a list of at most 32 texts."),
        ("train.iterations", UsageError, "--set takes section.key=value, not 'train.iterations'."),
    ],
)
def test_mistakes_in_overrides(override: str, error: type[GsbakeError], says: str) -> None:
    with pytest.raises(error) as caught:
        load_profile("smoke", [override])
    assert str(caught.value) == says


def test_an_integer_too_long_to_convert_is_shown_in_part(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"mesh\.faces = '9{59}… is invalid"):
        load_profile("smoke", ["mesh.faces=" + 5000 * "9"])
    with pytest.raises(BadInputError, match="is not valid TOML"):
        load_profile(write(tmp_path / "long.toml", "[mesh]\nfaces = " + 5000 * "9"))


def test_unknown_profile() -> None:
    with pytest.raises(UsageError, match="There is no profile 'relihgt': did you mean 'relight'?"):
        load_profile("relihgt")
    with pytest.raises(UsageError, match="there are 3dgsr, .*preview, quality, relight, scan, "):
        load_profile("/no/such.toml")


@pytest.mark.parametrize(
    ("key", "allowed"),
    [
        ("train.iterations", "a whole number from 0 to 10 000 000"), ("train.lr_sdf", "a number above 0, up to 1"),
        ("mesh.holes", "one of close, leave"), ("poses.source", "one of auto, given, solve"),
        ("poses.masked_features", "one of true, false, auto"), ("ingest.invert_masks", "true or false"), ("export.copyright", ""),
    ],
)  # fmt: skip
def test_bounds_in_words(key: str, allowed: str) -> None:
    assert bounds(fields()[key]) == allowed


def test_a_profile_that_is_too_large_to_be_one(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("#" * 1_000_001)
    with pytest.raises(BadInputError, match=r"a\.toml has 1 MB; a profile has at most 1 MB"):
        load_profile(str(path))
