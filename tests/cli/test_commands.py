"""Command line on a toy pipeline: output, files, stored options and exit codes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import trimesh
import xatlas

from gsbake.errors import BadInputError
from gsbake.geometry.ply import has_texture_coordinates, write_mesh
from gsbake.stages import ORDER
from tests.cli.conftest import Run


def test_run_publishes_the_results_and_caches_the_stages(run: Run, capture: Path, tmp_path: Path) -> None:
    end = run("run", capture)
    out = tmp_path / "out" / "tankard"
    assert end.code == 0, end.err
    assert {p.name for p in out.iterdir()} >= {"asset.glb", "cameras.json", "light.hdr", "report.html", "events.jsonl"}
    assert (out / "asset.glb").read_text() == "glb ply 30000"
    assert "gsbake: warning (ingest): photo 3 is blurred" in end.err
    lines = end.out.splitlines()
    assert [line.split()[1] for line in lines[:4]] == ["ingest:", "mesh:", "export:", "report:"]  # one line a stage
    assert lines[1].endswith("faces 30 000") and "all used" not in end.out
    assert [line.split()[0] for line in lines[4:]] == ["Asset", "Quality", "Warnings", "Report", "Time"]
    assert lines[4].split()[1] == "out/tankard/asset.glb"
    verbose = run("run", capture, "--out", "other", "-v").out
    assert "mesh: Meshing (not run yet)" in verbose and "ingest: skip.redundant_photos: all used (none twice)" in verbose
    again = run("run", capture)
    assert again.out.count("cached") == 4 and again.err == ""
    manifest = json.loads(next(out.glob("stages/ingest/*/manifest.json")).read_text())
    assert set(manifest["inputs"]["photos"]["files"]) == {"a.jpg", "b.jpg", "c.jpg"}
    assert set(manifest["inputs"]["masks"]["files"]) == {"a.png"} and "gt" not in json.dumps(manifest["inputs"])


def test_results_of_finished_stages_are_published_though_a_later_one_fails(run: Run, capture: Path, tmp_path: Path) -> None:
    end = run("run", capture, "--set", "mesh.faces=666")
    out = tmp_path / "out" / "tankard"
    assert end.code == BadInputError.exit_code and "no report on such a mesh" in end.err
    assert (out / "asset.glb").read_text() == "glb ply 666" and not (out / "report.html").exists()
    assert run("run", capture, "--set", "mesh.faces=667").code == 0  # what was published is known as gsbake's own
    assert (out / "asset.glb").read_text() == "glb ply 667" and (out / "report.html").exists()


def test_output_folder_stores_the_options(run: Run, capture: Path, tmp_path: Path) -> None:
    assert run("mesh", capture, "--out", "o", "--profile", "preview", "--set", "mesh.faces=500", "--seed", 3).code == 0
    project = json.loads((tmp_path / "o" / "project.json").read_text())
    assert project["photos"] == str(capture / "images") and project["masks"] == str(capture / "masks")
    assert project["profile"] == "preview" and project["overrides"] == ["mesh.faces=500"] and project["seed"] == 3
    end = run("export", "--out", "o", "--json")
    assert [(s["name"], s["status"]) for s in end.json["stages"]] == [("ingest", "cached"), ("mesh", "cached"), ("export", "ran")]
    assert (tmp_path / "o" / "asset.glb").read_text() == "glb ply 500" and end.json["files"]["asset.glb"] == "o/asset.glb"
    assert run("run", "--out", "o", "--set", "mesh.faces=600", "-q").out == ""
    assert (tmp_path / "o" / "asset.glb").read_text() == "glb ply 600"
    fresh = run("run", capture, "--out", "o", "--json")  # PHOTOS discards the stored options
    assert fresh.json["stages"][1]["results"] == {"faces": 30000}


def test_obsolete_result_is_deleted_unless_edited(run: Run, capture: Path, tmp_path: Path) -> None:
    run("run", capture, "--out", "o")
    assert (tmp_path / "o" / "light.hdr").exists()
    run("run", "--out", "o", "--profile", "preview")
    assert not (tmp_path / "o" / "light.hdr").exists()
    run("run", "--out", "o", "--profile", "relight")
    (tmp_path / "o" / "light.hdr").write_text("mine")
    run("run", "--out", "o", "--profile", "preview")
    assert (tmp_path / "o" / "light.hdr").read_text() == "mine"


def test_status_explain_and_dry_run(run: Run, capture: Path, tmp_path: Path) -> None:
    dry = run("run", capture, "--out", "o", "--dry-run")
    assert dry.code == 0 and "will run" in dry.out and not (tmp_path / "o").exists()
    run("run", capture, "--out", "o")
    states = run("status", "--out", "o", "--set", "mesh.faces=700", "--json").json["stages"]
    assert [s["will_run"] for s in states] == [False, True, True, True]
    assert states[1]["reasons"] == ["mesh.faces: 30000 → 700"]
    assert "decided skip.redundant_photos: all used (none twice)" in run("explain", "ingest", "--out", "o").out
    text = run("status", "--out", "o", "--set", "mesh.faces=700").out
    assert "mesh.faces: 30000 → 700" in text and "mesh will run first" in text
    (capture / "images" / "b.jpg").write_text("other")
    explained = run("explain", "ingest", "--out", "o").out
    assert "because photos: b.jpg changed" in explained and "ingest.min_photos = 3  (default)" in explained
    assert run("explain", "bakery", "--out", "o").err.startswith("gsbake: There is no stage 'bakery'")


def test_replace_and_undo(run: Run, capture: Path, tmp_path: Path) -> None:
    run("run", capture, "--out", "o")
    mine = tmp_path / "edited.ply"
    mine.write_text("ply mine")
    assert run("replace", "mesh", mine, "--out", "o", "--dry-run", "--json").json == {
        "stage": "mesh",
        "would_replace": ["dense.ply", "mesh.ply"],
    }
    end = run("replace", "mesh", mine, "--out", "o")
    assert end.code == 0 and "dense.ply, mesh.ply replaced; `gsbake run` continues from there" in end.out
    end = run("run", "--out", "o")
    assert "mesh: replaced by the user" in end.out and (tmp_path / "o" / "asset.glb").read_text() == "glb ply mine"
    run("replace", "mesh", "--undo", "--out", "o")
    run("run", "--out", "o")
    assert (tmp_path / "o" / "asset.glb").read_text() == "glb ply 30000"
    mine.write_text("obj")
    assert run("replace", "mesh", mine, "--out", "o").code == 42
    assert run("replace", "mesh", tmp_path / "none.ply", "--out", "o").code == 42
    assert run("replace", "mesh", "--out", "o").code == 2
    wrong = run("replace", "export", mine, "--out", "o")
    assert wrong.code == 2 and "it has asset.glb, cameras.json, light.hdr" in wrong.err


def test_replace_by_a_low_poly_mesh_with_uvs(run: Run, capture: Path, tmp_path: Path) -> None:
    """A GLB or OBJ takes the place of mesh.ply alone; its UVs are kept, and what it was made of is recorded."""
    run("run", capture, "--out", "o")
    ball = trimesh.creation.icosphere(subdivisions=3)
    write_mesh(tmp_path / "dense.ply", ball.vertices, ball.faces)
    coarse = trimesh.creation.icosphere(subdivisions=1)
    source, faces, uv = xatlas.parametrize(coarse.vertices, coarse.faces)
    mine = trimesh.Trimesh(coarse.vertices[source], faces, process=False, visual=trimesh.visual.TextureVisuals(uv=uv))
    mine.export(tmp_path / "mine.glb")
    dry = run("replace", "mesh", "mine.glb", "dense.ply", "--out", "o", "--dry-run", "--json").json
    assert dry["would_replace"] == ["dense.ply", "mesh.ply"] and dry["notes"][1] == "their UVs are kept"
    end = run("replace", "mesh", "mine.glb", "dense.ply", "--out", "o")
    assert end.code == 0 and "mine.glb: 80 triangles in the frame of mesh.ply" in end.out, end.err
    (folder,) = (tmp_path / "o" / "stages" / "mesh").glob("by-hand*/")
    assert has_texture_coordinates(folder / "mesh.ply")
    assert json.loads((folder / "manifest.json").read_text())["replaced"]["mesh.ply"].endswith("mine.glb")
    assert run("replace", "mesh", "mine.glb", "--out", "o").code == 0  # on the dense mesh that is there now
    assert run("replace", "mesh", "mine.glb", "mine.glb", "--out", "o").code == 2
    mine.apply_translation([9, 0, 0])
    mine.export(tmp_path / "mine.obj")
    away = run("replace", "mesh", "mine.obj", "--out", "o")
    assert away.code == 42 and "does not lie on the dense mesh" in away.err and away.err.count("\n") == 1


@pytest.fixture
def read_only(tmp_path: Path) -> Iterator[Callable[[Path], None]]:
    """Make a folder read-only, also for root (by a mount), until the end of the test."""
    mounted: list[Path] = []

    def protect(folder: Path) -> None:
        if os.geteuid() != 0:
            folder.chmod(0o555)
            return
        if subprocess.run(["mount", "--bind", str(folder), str(folder)], check=False, capture_output=True).returncode:
            pytest.skip("a folder cannot be mounted read-only here")
        mounted.append(folder)
        subprocess.run(["mount", "-o", "remount,bind,ro", str(folder)], check=True)

    yield protect
    for folder in mounted:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize("words", [["edited.ply"], ["--undo"]])
def test_replace_in_a_read_only_folder(
    run: Run, capture: Path, tmp_path: Path, read_only: Callable[[Path], None], words: list[str]
) -> None:
    run("run", capture, "--out", "o")
    (tmp_path / "edited.ply").write_text("ply mine")
    run("replace", "mesh", "edited.ply", "--out", "o")
    (tmp_path / "edited.ply").write_text("ply mine again")
    folder = tmp_path / "o" / "stages" / "mesh"
    read_only(folder)
    end = run("replace", "mesh", *words, "--out", "o")
    assert end.code == 42 and end.err.count("\n") == 1 and "cannot be written" in end.err, end.err


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["run", "nowhere"], 42, "nowhere does not exist"),
        (["run", "empty"], 42, "holds no photos"),
        (["run", "two"], 42, "There are 2 photos"),
        (["run", "tankard", "--set", "train.iteration=3"], 42, "the nearest is 'train.iterations'"),
        (["run", "tankard", "--profile", "relihgt"], 2, "did you mean 'relight'?"),
        (["run", "tankard", "--set", "nonsense"], 2, "--set takes section.key=value"),
        (["run", "tankard", "--masks", "nomasks"], 42, "nomasks does not exist"),
        (["run"], 2, "give the folder of photos"),
        (["mesh", "--out", "new"], 2, "holds no run yet"),
        (["run", "tankard", "--out", "tankard/images/a.jpg"], 2, "a file of that name exists"),
        (["run", "tankard", "--out", "/proc/nowhere"], 42, "choose another with --out"),
        (["run", "tankard", "--device", "cuda"], 2, "--device cuda is not available"),
        (["run", "tankard", "--seed", "-1"], 2, "The seed must be a whole number from 0 to 2 147 483 647, not -1."),
        (["status", "tankard", "--seed", "2147483648"], 2, "from 0 to 2 147 483 647, not 2147483648"),
        (["run", ""], 2, "'PHOTOS': the path is empty; '.' is the current folder"),
        (["run", "tankard", "--out", ""], 2, "the path is empty"),
        (["run", "tankard", "--masks", ""], 2, "the path is empty"),
        (["run", "tankard", "--poses", ""], 2, "the path is empty"),
        (["replace", "mesh", ""], 2, "the path is empty"),
        (["run", "tankard", "--profile", ""], 2, "There is no profile ''"),
        (["profiles", ""], 2, "There is no profile ''"),
        (["profiles", "."], 2, "There is no profile '.'"),
        (["profiles", "base.toml"], 42, 'base.toml: extends = "" names no profile'),
        (["run", "n" * 300], 42, "cannot be used (File name too long)"),
        (["run", "tankard", "--set", "mesh.faces=abc"], 42, "mesh.faces = 'abc' is not a number: it must be a whole number from 100 to 10"),
        (["run", "tankard", "--threads", "513"], 2, "The number of threads must be from 0 (the physical cores) to 512, not 513."),
        (["run", "tankard", "--threads", "-1"], 2, "from 0 (the physical cores) to 512, not -1."),
        (["run", "tankard", "--set", "train.holdout=1"], 42, "--set: train.holdout = 1 is invalid: it would hold out every photo; set 0"),
        (["run", "tankard", "--set", "loss.mask="], 42, "loss.mask = '' is not a number"),
        (["run", "tankard", "--set", "export.copyright=\udcff"], 2, "--set takes text, but 'export.copyright=\\udcff' is not valid UTF-8"),
        (["run", "tankard", "--require", "psnr"], 2, "'psnr' is not KEY=VALUE"),
        (["run", "tankard", "--require", "psnr=good"], 2, "'good' is not a number"),
        (["run", "tankard", "--require", "chamfer=1"], 2, "no figure 'chamfer'; choose from psnr"),
        (["mesh", "tankard", "--require", "psnr=22"], 2, "use it with `gsbake run`"),
        (["run", "tankard", "--fast"], 2, "No such option: --fast"),
        (["run", "tankard", "--seed", "x"], 2, "'--seed'"),
        (["bakery"], 2, "No such command 'bakery'"),
        (["run", "tankard", "--set", "loss.mask=inf"], 42, "loss.mask = inf is invalid: it must be a number from 0 to 10 000."),
    ],
)
def test_each_error_has_one_sentence_and_an_exit_code(
    run: Run, capture: Path, tmp_path: Path, arguments: list[str], code: int, says: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "two").mkdir()
    for name in ("a.png", "b.png"):
        (tmp_path / "two" / name).write_text(name)
    (tmp_path / "base.toml").write_text('extends = ""')
    end = run(*arguments)
    assert end.code == code
    errors = [line for line in end.err.splitlines() if "warning" not in line]
    assert len(errors) == 1 and errors[0].startswith("gsbake: ") and says in errors[0]
    machine = run(*arguments, "--json")
    assert machine.code == code and says in machine.json["error"] and machine.json["exit_code"] == code


def test_unknown_option_is_a_usage_error(run: Run, capture: Path) -> None:
    assert run("run", capture, "--fast").code == 2
    assert run("bakery").code == 2
    assert run("run", capture, "--device", "gpu").code == 2


def test_internal_error_is_one_sentence_with_a_saved_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    import gsbake.cli.inspect

    monkeypatch.setattr(gsbake.cli.inspect, "shipped", lambda: 1 / 0)
    end = run("profiles")
    assert end.code == 1 and end.err.count("\n") == 1 and "ZeroDivisionError" in end.err
    saved = Path(end.err.split("'")[-2])
    assert "Traceback" in saved.read_text()
    saved.unlink()


def test_a_run_worse_than_required_is_published_and_ends_with_a_code_of_its_own(run: Run, capture: Path, tmp_path: Path) -> None:
    assert run("run", capture, "--require", "psnr=21.5, bytes=1e6", "--require", "ssim=.9").code == 0
    end = run("run", capture, "--out", "o", "--require", "psnr=22,ssim=.5,bytes=999999,exposed_psnr=1")
    assert end.code == 3 and (tmp_path / "o" / "report.html").exists() and "Quality" in end.out
    worse = ("psnr is 21.5, not at least 22", "bytes is 1000000, not at most 999999", "exposed_psnr is none, not at least 1")
    assert end.err.splitlines()[-1] == f"gsbake: Worse than required: {'; '.join(worse)}."
    cached = run("report", "--out", "o", "--require", "psnr=22", "--json")
    assert cached.code == 3 and cached.json["exit_code"] == 3 and "psnr is 21.5" in cached.json["error"] and cached.json["stages"]


def test_invert_masks_is_a_setting(run: Run, capture: Path, tmp_path: Path) -> None:
    run("ingest", capture, "--out", "o", "--invert-masks")
    assert json.loads((tmp_path / "o" / "project.json").read_text())["overrides"] == ["ingest.invert_masks=true"]
    assert next((tmp_path / "o").glob("stages/ingest/*/photos.json")).read_text().endswith("TrueTrue")


def test_the_region_is_a_setting(run: Run, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "box.json").write_text('{"centre": [0, 1, 2], "size": [1, 2, 3]}')

    def stored(*words: object) -> list[str]:
        assert run("run", capture, "--out", "o", *words).code == 0
        found: list[str] = json.loads((tmp_path / "o" / "project.json").read_text())["overrides"]
        return found

    box = "poses.region_box=[0.0, 1.0, 2.0, 1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]"
    assert stored("--region", "box.json") == ["poses.region=auto", box]
    assert stored("--region", "none") == ["poses.region=none", "poses.region_box=[]"]
    (tmp_path / "box.json").write_text('{"centre": [0, 1, 2]}')
    end = run("run", capture, "--region", "box.json")
    assert end.code == 42 and end.err.count("\n") == 1 and "'box.json' is no region" in end.err


def test_masks_none_and_auto_are_settings(run: Run, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    for choice, setting in (("none", "ignore"), ("auto", "auto")):
        run("ingest", capture, "--out", choice + "-out", "--masks", choice)
        project = json.loads((tmp_path / f"{choice}-out" / "project.json").read_text())
        assert project["overrides"] == [f"ingest.masks={setting}"] and project["masks"] == str(capture / "masks")
    run("ingest", capture, "--out", "folder", "--masks", "./none")
    assert json.loads((tmp_path / "folder" / "project.json").read_text())["masks"] == str(tmp_path / "none")
    end = run("ingest", "--out", "none-out", "--masks", "./none")
    assert end.code == 2 and "ingest.masks is ignore" in end.err


def test_profiles_are_listed_and_shown(run: Run) -> None:
    family = {
        "dsdf", "gs-ror2", "3dgsr", "gsdf", "gs-octree", "gs-pull", "surfacesplat", "splatsdf", "gaussianroom", "ugsdf", "sdf-3dgan",
        "neus", "volsdf",
    }  # fmt: skip
    for_assets = {"smoke", "preview", "relight", "quality", "scan"}
    assert set(run("profiles", "--json").json) == for_assets
    assert set(run("profiles", "--all", "--json").json) == for_assets | family
    listed = run("profiles").out
    assert listed.count("\n") == 10 and "relight (default)" in listed and "--all lists 13 published systems" in listed
    assert "--all" not in run("profiles", "--all").out
    shown = run("profiles", "smoke", "--set", "mesh.faces=123", "--json").json
    assert shown["mesh.faces"]["value"] == 123 and shown["mesh.faces"]["origin"] == "--set"
    assert shown["train.iterations"]["origin"] == "smoke" and shown["ingest.min_photos"]["origin"] == "default"
    assert "Training iterations" in run("profiles", "smoke").out


def test_help_imports_no_large_library() -> None:
    start = "import sys; sys.argv = ['gsbake', '--help']; from gsbake.cli import main"
    code = f"{start}\ntry: main()\nexcept SystemExit: pass\nprint('LOADED', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "report" in done.stdout
    loaded = set(done.stdout.split("LOADED")[1].split())
    assert loaded.isdisjoint({"torch", "numba", "cv2", "numpy", "scipy", "trimesh", "pydantic", "rich.progress", "gsbake.stages.train"})


def test_help_groups_commands_and_options_in_panels(run: Run) -> None:
    text = run("--help").out
    titles = re.findall(r"(?m)^(\S.*):$", text)
    assert titles == ["Make", "Inspect", "Edit", "Many captures", "Files", "Single stages", "Options"]
    panels = dict(zip(titles, re.split(r"(?m)^\S.*:$", text)[1:], strict=True))
    listed = {title: re.findall(r"(?m)^  ([a-z]+) ", panels[title]) for title in titles[:-1]}
    assert listed["Make"] == ["run", "check", "studio", "synth"] and listed["Many captures"] == ["plan", "batch", "cache"]
    assert listed["Single stages"] == list(ORDER) and sum(map(len, listed.values())) == 27
    assert "..." not in re.sub(r"\[ARGS\]\.\.\.", "", text)  # no sentence is cut
    for command in ("run", "mesh"):
        options = run(command, "--help").out
        main, photos, common = (options.index(f"\n{title}:\n") for title in ("Options", "Options of the photos", "Common options"))
        assert main < options.index("--out") < options.index("--profile") < photos < options.index("--masks auto") < common
        assert all(options.index(f" {name} ") > common for name in ("--device", "--threads", "--seed", "--json", "--help"))


def test_completion_of_stages_profiles_and_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    from gsbake.cli.options import complete_profile, complete_setting, complete_stage

    assert complete_profile("pr") == ["preview"] and complete_stage("re") == ["refine", "report"]
    assert complete_setting("mesh.fa") == ["mesh.faces="]


def test_a_run_says_the_time_left_or_that_it_is_unknown(run: Run, capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import gsbake.cli.display

    monkeypatch.setattr(gsbake.cli.display, "PROGRESS_INTERVAL", 0.0)
    lines = [line for line in run("run", capture).out.splitlines() if " of 3" in line]
    assert lines and all(re.search(r", (time left unknown|about [\d.]+ s left)$", line) for line in lines)


def test_settings_are_stored_for_the_next_run(run: Run, capture: Path) -> None:
    """`gsbake settings` runs nothing; the next run has what it stored, and each flag is its setting."""
    box = Path("box.json")
    box.write_text('{"centre": [0, 0, 1], "size": [1, 1, 2]}')
    flags = ("--leave-out", "a.jpg", "--up", "0,0,0 1,0,0 0,1,0", "--front", "b.jpg", "--origin", "centre", "--region", box)
    found = run("settings", capture, "--out", "o", "--set", "mesh.faces=777", *flags, "--json").json
    turn = "1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0"
    assert found["settings"] == [
        "mesh.faces=777", "poses.region=auto", f"poses.region_box=[0.0, 0.0, 1.0, 1.0, 1.0, 2.0, {turn}]",
        "export.up_points=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]", 'ingest.leave_out=["a.jpg"]', "export.front=b.jpg",
        "export.origin=centre",
    ]  # fmt: skip
    assert not Path("o/stages").exists()
    assert run("run", "--out", "o", "--json").json["stages"][1]["results"] == {"faces": 777}
    changed = run("settings", "--out", "o", "--unset", "mesh.faces", "--up", "ground", "--json").json["settings"]
    assert {"export.up=ground", "export.up_points=[]", "export.front=b.jpg"} < set(changed) and "mesh.faces=777" not in changed
    assert run("run", "--out", "o", "--json").json["stages"][1]["results"] == {"faces": 30_000}


@pytest.mark.parametrize(
    "words, sentence",
    [
        (("--unset", "mesh.triangles"), "There is no setting 'mesh.triangles' to unset"),
        (("--up", "sideways"), "'sideways' is neither cameras, markers or ground nor two or three points"),
        (("--up", "0,0,0 1,0"), "nor two or three points"),
        (("--set", "export.up_points=[1, 2]"), "so nine or six numbers"),
        (("--up", "0,0,0 1,1,1 2,2,2"), "coincide or lie on one line"),
        (("--up", "0,0,0 1,0,0 0,0,0"), "coincide or lie on one line"),
        (("--up", "-1e308,0,0 1e308,0,0"), "coincide or lie on one line"),
    ],
)
def test_settings_that_are_none(words: tuple[str, ...], sentence: str, run: Run, capture: Path) -> None:
    end = run("settings", capture, "--out", "o", *words)
    assert end.code in (2, 42) and sentence in end.err and not Path("o").exists()
