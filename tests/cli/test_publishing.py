"""Results never replace a file that the user edited or made, and nothing but results is published, whatever an output or a project says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from blake3 import blake3

import gsbake
import gsbake.api
from gsbake.pipeline.project import PROJECT, Project
from gsbake.pipeline.store import Store
from gsbake.publish import RESULTS, Publication, publish_results
from tests.cli import toy_bake
from tests.cli.conftest import Run


def names(out: Path, pattern: str) -> set[str]:
    return {path.name for path in out.glob(pattern)}


def publish(out: Path, text: str, *, overwrite: bool = False) -> Publication:
    """Publish an export whose files hold `text`, as a run that computed it does."""
    store = Store(out)
    key = blake3(text.encode()).hexdigest()
    temporary = store.temporary("export", key)
    for name in RESULTS["export"]:
        (temporary / name).write_text(text)
    artifact = store.publish(temporary, store.folder("export", key), {"stage": "export"})
    done = publish_results(out, {"export": artifact}, Project.load(out) or Project(), store, overwrite=overwrite)
    done.project.save(out)
    return done


def test_an_edited_asset_stays_though_everything_is_cached(run: Run, capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    run("run", capture, "--out", "o")
    (out / "asset.glb").write_text("edited in another program")
    end = run("run", "--out", "o")
    assert end.code == 0 and (out / "asset.glb").read_text() == "edited in another program"
    assert (out / "asset.new.glb").read_text() == "glb ply 30000"
    (line,) = end.err.splitlines()
    assert "'o/asset.glb' is not as gsbake published it and stays" in line and "asset.new.glb" in line and "--overwrite" in line
    assert next(text for text in end.out.splitlines() if text.startswith("Asset")).split()[1] == "o/asset.new.glb"
    assert run("run", "--out", "o", "--json").json["files"]["asset.glb"] == "o/asset.new.glb"
    run("run", "--out", "o", "--set", "mesh.faces=500")  # gsbake's own file beside it is replaced by the next one
    assert (out / "asset.new.glb").read_text() == "glb ply 500" and (out / "asset.glb").read_text() == "edited in another program"
    assert names(out, "asset*") == {"asset.glb", "asset.new.glb"}
    taken = gsbake.run(out=out, overwrite=True)
    assert taken.files["asset.glb"] == out / "asset.glb" and names(out, "asset*") == {"asset.glb"}
    assert run("cache", "gc", "--out", "o", "--keep", "0").code == 0
    assert (out / "set-aside" / "asset.glb").read_text() == "edited in another program"


def test_an_edited_file_is_set_aside_on_request(tmp_path: Path) -> None:
    for text in ("edited", "edited again"):
        publish(tmp_path, "glb")
        (tmp_path / "asset.glb").write_text(text)
        assert publish(tmp_path, "glb").files["asset.glb"].name == "asset.new.glb"
        done = publish(tmp_path, "glb", overwrite=True)
        assert done.files["asset.glb"] == tmp_path / "asset.glb" and (tmp_path / "asset.glb").read_text() == "glb"
        assert names(tmp_path, "asset*") == {"asset.glb"} and len(done.notes) == 1 and "set-aside" in done.notes[0][1]
    assert {path.read_text() for path in tmp_path.glob("set-aside/asset*.glb")} == {"edited", "edited again"}
    assert publish(tmp_path, "glb").notes == ()


def test_the_file_beside_an_edited_one_may_be_edited_too(tmp_path: Path) -> None:
    publish(tmp_path, "glb")
    (tmp_path / "asset.glb").write_text("mine")
    publish(tmp_path, "glb")
    (tmp_path / "asset.new.glb").write_text("mine too")
    assert publish(tmp_path, "glb").files["asset.glb"] == tmp_path / "asset.new2.glb"
    assert (tmp_path / "asset.new.glb").read_text() == "mine too"
    (tmp_path / "asset.glb").unlink()  # what the user has moved away is published in its own place again
    publish(tmp_path, "glb")
    assert (tmp_path / "asset.glb").read_text() == "glb" and (tmp_path / "asset.new.glb").read_text() == "mine too"
    assert not (tmp_path / "asset.new2.glb").exists()


def test_taking_the_new_file_by_hand_is_understood(tmp_path: Path) -> None:
    publish(tmp_path, "glb")
    (tmp_path / "asset.glb").write_text("mine")
    publish(tmp_path, "glb")
    (tmp_path / "asset.new.glb").replace(tmp_path / "asset.glb")
    assert publish(tmp_path, "glb").notes == () and names(tmp_path, "asset*") == {"asset.glb"}
    publish(tmp_path, "another")
    assert (tmp_path / "asset.glb").read_text() == "another" and names(tmp_path, "asset*") == {"asset.glb"}


def test_what_a_killed_run_published_is_known_as_gsbakes(tmp_path: Path) -> None:
    """Killed after the copy and before the record of it."""
    publish(tmp_path, "one")
    record = (tmp_path / PROJECT).read_text()
    publish(tmp_path, "two")
    (tmp_path / PROJECT).write_text(record)
    assert publish(tmp_path, "three").notes == ()
    assert (tmp_path / "asset.glb").read_text() == "three" and names(tmp_path, "asset*") == {"asset.glb"}


def test_what_gsbake_never_published_stays(tmp_path: Path) -> None:
    """A file, a link and a folder in the place of a result."""
    elsewhere = tmp_path / "elsewhere.glb"
    elsewhere.write_text("precious")
    (tmp_path / "asset.glb").symlink_to(elsewhere)
    (tmp_path / "light.hdr").mkdir()
    (tmp_path / "cameras.json").write_text("mine")
    files = publish(tmp_path, "glb").files
    assert {path.name for path in files.values()} == {"asset.new.glb", "light.new.hdr", "cameras.new.json"}
    assert {path.read_text() for path in files.values()} == {"glb"} and elsewhere.read_text() == "precious"
    assert (tmp_path / "asset.glb").is_symlink() and (tmp_path / "cameras.json").read_text() == "mine"
    publish(tmp_path, "glb", overwrite=True)
    assert elsewhere.read_text() == "precious" and all((tmp_path / name).read_text() == "glb" for name in files)
    assert not (tmp_path / "asset.glb").is_symlink() and (tmp_path / "set-aside" / "asset.glb").is_symlink()
    assert (tmp_path / "set-aside" / "light.hdr").is_dir() and (tmp_path / "set-aside" / "cameras.json").read_text() == "mine"


def test_an_output_of_targets_and_a_projects_record_decide_no_path(
    run: Run, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only files of targets are published, not through a link, and nothing but results is deleted."""
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.WITH_TARGETS)
    end = run("run", capture, "--out", "o", "--target", "web")
    out = tmp_path / "o"
    assert end.code == 0 and (out / "asset_web.glb").exists() and (out / "asset_film" / "base_color.exr").exists()
    found = [path.relative_to(out) for path in out.rglob("*") if path.is_file() and path.read_bytes() == b"from the targets"]
    assert {path.name for path in found if path.parts[0] != "stages"} == {"asset_web.glb", "base_color.exr"}
    assert (out / "asset.glb").read_text() == "glb ply 30000" and not (out / "stages" / "planted").exists()
    lines = [line for line in end.err.splitlines() if "not published" in line]
    assert len(lines) == 1 and "(targets)" in lines[0]
    project = json.loads((out / "project.json").read_text())
    digest = project["published"]["asset_web.glb"]
    victims = ["../victim.txt", "victim.txt", "logs/../../victim2.txt", "logs/victim.txt", str(tmp_path / "victim3.txt")]
    for name in victims:
        (out / name).write_text("from the targets")
    (out / "project.json").write_text(json.dumps({**project, "published": {**dict.fromkeys(victims, digest), "light.hdr": "0"}}))
    (out / "asset_film").rename(tmp_path / "moved")
    (tmp_path / "elsewhere").mkdir()
    (out / "asset_film").symlink_to(tmp_path / "elsewhere")
    end = run("run", "--out", "o")
    assert end.code == 0 and "'asset_film/base_color.exr' is not published" in end.err and not list((tmp_path / "elsewhere").iterdir())
    assert all((out / name).read_text() == "from the targets" for name in victims)
    assert not set(victims) & json.loads((out / "project.json").read_text())["published"].keys()
