"""Targets as text, and what they need."""

from __future__ import annotations

import pytest

from gsbake.config.schema import Targets
from gsbake.config.targets import BUDGETS, Target, is_target_file, parse_target, require_packages
from gsbake.errors import UsageError


@pytest.mark.parametrize(
    ("text", "target", "stem", "form"),
    [
        ("web", Target("web"), "asset_web", "glb"),
        ("default:meshopt+ktx2", Target("default", ("ktx2", "meshopt")), "asset_ktx2_meshopt", "glb"),
        (" ar:usdz ", Target("ar", ("usdz",)), "asset_ar", "usdz"),
        ("default:obj", Target("default", ("obj",)), "asset", "obj"),
        ("surfels", Target("surfels"), "asset_surfels", "ply"),
    ],
)
def test_targets(text: str, target: Target, stem: str, form: str) -> None:
    found = parse_target(text)
    assert found == target and (found.stem, found.file_form) == (stem, form)
    assert parse_target(found.text) == found


def test_names_of_other_files_are_no_targets() -> None:
    for name in ("asset.glb", "asset_web.glb.sh", "asset_film/../x.exr", "asset_film/sub/orm.exr", "asset_web/orm.exr", ".asset.usdz", "",
                 "asset_web_lod1.exe", "asset.obj\n", "surfels.ply/x", "asset_lod0.glb", "ASSET_WEB.glb", "/asset.usdz"):  # fmt: skip
        assert not is_target_file(name), name
    for name in ("asset_lod1.glb", "asset_lods.glb", "asset_film_webp/orm.exr", "asset_planner_base_color.jpg", "asset_lod2.usdc"):
        assert is_target_file(name), name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mobile", "no target"), ("web:draco", "no form"), ("film:udim", "UDIM"), ("udim", "one UV tile"),
        ("web:webp+ktx2", "several"), ("ar:usdz+obj", "several"), ("ar:usdz+meshopt", "stand alone"), ("surfels:usdz", "no forms"),
        ("web:", "no form"), ("", "no target"),
    ],
)  # fmt: skip
def test_wrong_targets(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_target(text)
    with pytest.raises(ValueError, match=message):
        Targets(files=(text,))


def test_budgets_follow_the_guidelines() -> None:
    assert {n: (b.megabytes, b.triangles, b.texture) for n, b in BUDGETS.items() if n in ("web", "ar", "banner", "planner")} == {
        "web": (3, 150_000, 2048), "ar": (3, 150_000, 2048), "banner": (0.5, 30_000, 512), "planner": (1, 40_000, 1024),
    }  # fmt: skip


def test_a_missing_package_is_named_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    require_packages([parse_target("web"), parse_target("web:webp")])
    with pytest.raises(UsageError, match=r"gsbake\[usd\]"):
        require_packages([parse_target("ar:usdz")])
    with pytest.raises(UsageError, match=r"alktx2.*gsbake\[web\]"):
        require_packages([parse_target("web:ktx2")])
