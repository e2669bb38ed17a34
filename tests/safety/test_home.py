"""Every command that writes, pointed at every folder of a home full of look-alikes.

No file of the user's is missing or changed, and nothing new lies in a folder that is neither new, nor empty, nor gsbake's own.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import gsbake.api
from gsbake.batch import coordinator, workflow
from gsbake.batch.captures import BatchOptions
from gsbake.batch.job import run_job
from gsbake.batch.records import save_batch
from tests.cli.conftest import Run, run
from tests.safety import stages
from tests.safety.home import BATCH, FEW, FOLDERS, FOREIGN, FREE, LINKS, OWN, STORE, Damage, Home, make_old, snapshot, write_home
from tests.support.gltf_files import write_ball

__all__ = ["run"]
#: Stands for the folder or file that a command is pointed at.
TARGET = "TARGET"
#: What the user put among gsbake's own files, and has nowhere else.
LIGHT, MESH, NOTE = "light by hand", "ply, retouched in place", "to do"
#: What stays under its own name there.
PINNED = frozenset({f"{OWN}/asset.glb", f"{OWN}/notes.txt", f"{OWN}/stages/mesh/scan.tmp-keep/scan.bin", f"{BATCH}/index.html"})
IMAGES = ("ball.glb", "asset.glb", "pictures/photo.png", "pictures/film.mp4", "models/asset.glb", "new.png")


@dataclass(frozen=True)
class Command:
    """A command with TARGET among its words, and the places in the home, beside TARGET, where it may make new files."""

    words: str
    targets: Sequence[str] = FOLDERS
    places: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        return f"gsbake {self.words}"


COMMANDS = (
    Command("run scans/mug --out TARGET"),
    Command("run other/tankard --out TARGET"),
    Command("run capture/images --out TARGET"),
    Command("run scans/tankard --out TARGET"),
    Command("run --out TARGET"),
    Command("mesh scans/mug --out TARGET"),
    Command("run scans/mug --out new/run --store TARGET", places=("new/run",)),
    Command("run scans/mug", (TARGET,)),
    Command("batch scans/mug --out TARGET"),
    Command("batch scans/mug --out new/batch --store TARGET", places=("new/batch",)),
    Command("batch status --out TARGET"),
    Command("plan scans/mug --out TARGET --emit sh"),
    Command("plan scans/mug --out new/plan --store TARGET"),
    Command("replace mesh edited.ply --out TARGET"),
    Command("replace export light.hdr --out TARGET"),
    Command("replace mesh TARGET --out work/out/tankard"),
    Command("replace export --undo --out TARGET"),
    Command("masks TARGET --out work/out/tankard"),
    Command("synth TARGET --views 3 --size 16"),
    Command("synth TARGET --dry-run"),
    Command("cache ls --out TARGET"),
    Command("cache verify --out TARGET"),
    Command("cache gc --out TARGET"),
    Command("cache gc --out TARGET --keep 0"),
    Command("cache gc --out TARGET --older 0h"),
    Command("cache gc --out TARGET --dry-run"),
    Command("cache ls --store TARGET"),
    Command("cache verify --store TARGET"),
    Command("cache gc --store TARGET"),
    Command("cache gc --store TARGET --keep 0"),
    Command("cache gc --store TARGET --dry-run"),
    Command("cache quota 5MB --store TARGET"),
    Command("status --out TARGET"),
    Command("explain --out TARGET"),
    Command("doctor --out TARGET", (".", "proj", "empty", "new/folder")),  # it imports every library each time
    Command("check TARGET", ("photos", "capture", "scans/mug", "thesis.odt")),
    Command("profiles", (TARGET,)),
    Command("inspect ball.glb", (TARGET,)),
    Command("compare ball.glb ball.glb --views 1 --size 16 --sheet TARGET", IMAGES),
    Command("render ball.glb --views 1 --size 16 --samples 1 --turntable TARGET", IMAGES),
)
#: Commands by which files were lost, on the folders with which they were; the quick tests run these.
QUICK = (
    "run scans/mug --out TARGET", "run scans/tankard --out TARGET", "run other/tankard --out TARGET", "batch status --out TARGET",
    "cache gc --out TARGET", "cache ls --store TARGET", "cache gc --store TARGET", "synth TARGET --views 3 --size 16",
    "replace export light.hdr --out TARGET", "replace export --undo --out TARGET",
)  # fmt: skip


@pytest.fixture(scope="module")
def _folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("safety")


@pytest.fixture
def home(run: Run, _folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Home]:
    """The home as current folder; gsbake's own folders in it are made once."""
    monkeypatch.setattr(gsbake.api, "REGISTRY", stages.REGISTRY)
    monkeypatch.setattr(coordinator, "run_workflow", _in_this_process)
    monkeypatch.delenv("GSBAKE_STORE", raising=False)
    root, copy = _folder / "home", _folder / "copy"
    if not copy.exists():
        root.mkdir()
        write_home(root)
        write_ball(root / "ball.glb", (200, 100, 50))
        monkeypatch.chdir(root)
        assert run("run", "scans/tankard", "--out", OWN, "--store", STORE, "--quiet").code == 0
        (root / "work" / "light.hdr").write_text(LIGHT)
        assert run("replace", "export", "work/light.hdr", "--out", OWN, "--quiet").code == 0
        assert run("run", "--out", OWN, "--quiet").code == 0
        _edit_by_hand(root / OWN)
        save_batch([Path("scans/mug")], BatchOptions(root / BATCH, "smoke"))
        (root / BATCH / "index.html").write_text("<html>my index")
        make_old(root)
        os.chdir(_folder)
        shutil.copytree(root, copy, symlinks=True)
    elif root.exists():
        shutil.rmtree(root)
        shutil.copytree(copy, root, symlinks=True)
    before = snapshot(root)
    kept = frozenset(hashlib.sha256(text.encode()).hexdigest() for text in (LIGHT, MESH, NOTE))
    assert kept <= {entry.content for entry in before.values()}
    yield Home(root, copy, before, kept, PINNED)
    os.chdir(_folder)


def _edit_by_hand(out: Path) -> None:
    """What users do in an output folder: edit the asset, edit a stage's output, put files beside it; the file that replaces the light is
    nowhere else."""
    (out.parents[1] / "light.hdr").unlink()
    (out / "light.hdr").unlink()
    (out / "asset.glb").write_text("glb, retouched in Blender")
    (out / "notes.txt").write_text("notes")
    mesh = next(path for path in (out / "stages" / "mesh").iterdir() if (path / "dense.ply").is_file())
    (mesh / "dense.ply").write_text(MESH)
    (mesh / "todo.txt").write_text(NOTE)
    keep = out / "stages" / "mesh" / "scan.tmp-keep"
    keep.mkdir()
    (keep / "scan.bin").write_text("months of work")


def _in_this_process(jobs: Any, options: Any, execution: Any, reader: Any, stop: Any, on_record: Callable[[Any], None]) -> bool:
    """The jobs of a batch one after another, with all files that the batch writes for Snakemake."""
    work = options.root / ".batch" / "snakemake"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    workflow._prepare(jobs, options, execution, work, "")
    document = json.loads((work / "jobs.json").read_text())
    for job in jobs:
        on_record(run_job(document, job.id))
    return True


def places_of(command: Command, target: str) -> tuple[str, ...]:
    """Where a command may make new files in the home."""
    if command.words == "batch scans/mug --out TARGET" and target in FOREIGN:
        # a folder of outputs may hold other things too; the capture's own folder must be free
        folder = LINKS.get(target, target)
        return tuple(os.path.normpath(f"{folder}/{name}") for name in (".batch", "index.html", "index.new.html", "mug"))
    free = target in FREE or target == "new.png"
    return (*command.places, *((target,) if free else ()))


def run_everywhere(run: Run, home: Home, command: Command, targets: Sequence[str]) -> tuple[Damage, list[str]]:
    """Run a command on each target in the same home; returns what it did to the user's files, and the internal errors."""
    total, errors = Damage(), []
    for target in targets:
        os.chdir(home.root)
        words = [target if word == TARGET else word for word in command.words.split()]
        end = run(*words)
        if end.code not in (0, 2, 42, 75):
            errors.append(f"{' '.join(words)}: {end.err}")
        places = [place for place in places_of(command, target) if place in FREE or place not in home.before]
        now = snapshot(home.root)
        total.add(home.damage(now, tuple(places)), " ".join(words))
        os.chdir(home.copy)
        if now != home.before:
            home.restore()
    return total, errors


def check(run: Run, home: Home, command: Command, targets: Sequence[str], capsys: pytest.CaptureFixture[str] | None = None) -> None:
    damage, errors = run_everywhere(run, home, command, targets)
    if capsys is not None:
        with capsys.disabled():
            counts = f"{len(damage.missing)} missing, {len(damage.changed)} changed, {len(damage.intruding)} new ones among them"
            sys.stdout.write(f"\nhome: {command.title}: {len(targets)} targets, {home.count} files, {counts}\n")
    assert not errors
    assert not damage, str(damage)


@pytest.mark.parametrize("words", QUICK)
def test_known_holes(run: Run, home: Home, words: str) -> None:
    command = next(command for command in COMMANDS if command.words == words)
    check(run, home, command, FEW)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.words)
def test_every_command_everywhere(run: Run, home: Home, command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    check(run, home, command, command.targets, capsys)


def test_the_harness_sees_damage(home: Home) -> None:
    assert not home.damage(snapshot(home.root), ())
    (home.root / "thesis.odt").write_text("lost")
    (home.root / "tmp" / "draft.txt").unlink()
    (home.root / "photos" / "out.txt").write_text("new")
    (home.root / "repo/.git/hooks/post-checkout").chmod(0o644)
    (home.root / "work" / "new").write_text("own")
    os.utime(home.root / "report.html")
    for path in (home.root / OWN / "stages" / "mesh").glob("*/dense.ply"):
        path.write_text("gone")
    found = home.damage(snapshot(home.root), ())
    assert sorted(found.changed) == ["repo/.git/hooks/post-checkout", "report.html", "thesis.odt"]
    assert found.missing[0] == "tmp/draft.txt" and len(found.missing) == 2 and found.intruding == ["photos/out.txt"]
