"""A home folder full of files that look like gsbake's and are not, and what a command did to them."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
from dataclasses import dataclass, field
from pathlib import Path

#: gsbake's own folders in the home: an output folder, a shared store, and the folder of a batch.
OWN, STORE, BATCH = "work/out/tankard", "work/store", "work/batch"
#: Modification time of the user's files: older than any grace.
_OLD = 1_000_000_000
_KEY = "0123456789abcdef"
_SHA = hashlib.sha256(b"bazel").hexdigest()

#: The user's files. Names are those that gsbake uses, or nearly.
FILES = {
    "thesis.odt": "thesis",
    "asset.glb": "of another program",
    "cameras.json": '{"cameras": []}',
    "report.html": "<html>annual report</html>",
    "transforms.json": '{"frames": []}',
    "index.html": "<html>my home page</html>",
    "store.json": '{"name": "grocery"}',
    "edited.ply": "ply by hand",
    "light.hdr": "another light",
    ".envrc": "export A=1",
    "tmp/draft.txt": "draft",
    "tmp/deep/er/note": "note",
    "cas/ab/recipe.txt": "recipe",
    "ac/mesh/notes.json": "{}",
    "ac/mesh/plain.txt": "not JSON",
    "photos/a.jpg": "a", "photos/b.jpg": "b", "photos/c.jpg": "c",
    f"bazel/ac/{_SHA[:2]}/{_SHA}": "action", f"bazel/cas/{_SHA[:2]}/{_SHA}": "blob", "bazel/tmp/upload": "half",
    "bazel-named/ac/mesh/x.json": '{"files": {}}', f"bazel-named/cas/{_SHA[:2]}/{_SHA}": "blob",
    "proj/project.json": '{"name": "web", "version": "1.0.0"}',
    "proj/stages/mesh/scan.tmp-keep/data.bin": "months of work",
    "proj/stages/train/model-final.checkpoint/weights.pt": "weights",
    f"proj/stages/mesh/{_KEY}.checkpoint/weights.pt": "weights", f"proj/stages/mesh/{_KEY}.tmp-1/part": "part",
    f"proj/stages/mesh/{_KEY}/manifest.json": '{"stage": "mesh"}', f"proj/stages/mesh/{_KEY}.lease": "{}",
    "proj/stages/mesh/replaced.json": '{"folder": "by-hand-01234567"}', "proj/stages/mesh/by-hand-01234567/mesh.ply": "ply",
    "proj/events.jsonl": '{"event": "click"}\n', "proj/digests.json": "{}", "proj/logs/server.log": "log", "proj/errors/one.txt": "error",
    "plain/stages/export/v1.checkpoint/x": "x", "plain/stages/ingest/raw.tmp-1/x": "x",
    "models/asset.glb": "model", "models/cameras.json": "[]", "models/report.html": "<html>", "models/light.hdr": "light",
    "capture/transforms.json": '{"frames": [1]}', "capture/images/000.png": "a photo", "capture/images/a.jpg": "a",
    "capture/images/b.jpg": "b", "capture/masks/a.png": "mask", "capture/truth/mesh.ply": "scanned for days",
    "site/index.html": "<html>site", "site/.batch/batch.json": '{"batch": 7}', "site/.batch/lock": "", "site/.batch/records/r.json": "{}",
    "site/.batch/snakemake/notes.txt": "notes", "site/mug/index.html": "<html>mug",
    "shop/store.json": '{"quota_bytes": "seven"}', "shop/ac/list.json": "[]", "shop/cas/cash.ods": "cash", "shop/tmp/bill.pdf": "bill",
    "out/report.html": "<html>", "out/tankard.txt": "tankard", "out/mug/drawing.svg": "<svg/>",
    "results/truth/one.csv": "1", "results/set-aside/two.csv": "2", "results/unexpected/three.csv": "3", "results/targets/web.glb": "4",
    "repo/.git/hooks/post-checkout": "#!/bin/sh\n", "repo/.git/config": "[core]\n", "repo/synth.json": "{}",
    "odd/two\nlines.txt": "x", "odd/ spaces ": "x", os.fsdecode(b"odd/caf\xe9"): "x", "odd/-rf": "x", "odd/$(id)": "x",
    "pictures/photo.png": "a picture", "pictures/film.mp4": "a film",
    "scans/mug/images/a.jpg": "1", "scans/mug/images/b.jpg": "2", "scans/mug/images/c.jpg": "3", "scans/mug/notes.txt": "mug",
    "scans/tankard/images/a.jpg": "4", "scans/tankard/images/b.jpg": "5", "scans/tankard/images/c.jpg": "6",
    "other/tankard/images/a.jpg": "7", "other/tankard/images/b.jpg": "8", "other/tankard/images/c.jpg": "9",
}  # fmt: skip
LINKS = {"linked": "models", "photo-link": "photos", "models/broken": "nowhere", "results/link.csv": "truth/one.csv"}
#: Folders that a command may be pointed at: others' first, then two that are free, then gsbake's own.
FOREIGN = (
    ".", "tmp", "bazel", "bazel-named", "proj", "plain", "models", "linked", "capture", "capture/images", "photos", "scans", "site", "shop",
    "out", "results", "repo", "odd", "thesis.odt",
)  # fmt: skip
FREE = ("empty", "new/folder")
FOLDERS = (*FOREIGN, *FREE, OWN, STORE, BATCH)
#: The folders that the known holes were found with.
FEW = (".", "bazel", "proj", "models", "site", OWN, BATCH)


def write_home(home: Path) -> None:
    """The user's files, all old, and an empty folder."""
    for name, text in FILES.items():
        path = home / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (home / "repo/.git/hooks/post-checkout").chmod(0o755)
    for name, target in LINKS.items():
        (home / name).symlink_to(target)
    (home / "empty").mkdir()
    make_old(home)


def make_old(home: Path) -> None:
    """Everything in the home as old as can be."""
    for path in home.rglob("*"):
        if path.is_file() and not path.is_symlink():
            os.utime(path, (_OLD, _OLD))


@dataclass(frozen=True)
class Entry:
    """A file, link or folder: kind and mode, digest of a file or target of a link, modification time of a file."""

    mode: int
    content: str
    modified: int


def snapshot(home: Path) -> dict[str, Entry]:
    """{path relative to the home: entry} of everything in it."""
    found = {}
    for folder, folders, files in os.walk(home):
        for name in (*folders, *files):
            path = os.path.join(folder, name)
            status = os.lstat(path)
            if stat.S_ISLNK(status.st_mode):
                entry = Entry(stat.S_IFMT(status.st_mode), os.readlink(path), status.st_mtime_ns)
            elif stat.S_ISREG(status.st_mode):
                entry = Entry(status.st_mode, hashlib.sha256(Path(path).read_bytes()).hexdigest(), status.st_mtime_ns)
            else:
                entry = Entry(status.st_mode, "", 0)
            found[os.path.relpath(path, home)] = entry
    return found


def inside(name: str, folder: str) -> bool:
    """Whether a path is a folder or inside it."""
    return name == folder or name.startswith(f"{folder}/")


@dataclass
class Damage:
    """The user's files that are gone, or have other bytes, another mode or time; and new ones in a folder that is neither free nor
    gsbake's."""

    missing: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    intruding: list[str] = field(default_factory=list)

    def add(self, other: Damage, command: str) -> None:
        """Count what another command did."""
        for name in ("missing", "changed", "intruding"):
            getattr(self, name).extend(f"{command}: {path}" for path in getattr(other, name))

    def __str__(self) -> str:
        kinds = {"missing": self.missing, "changed": self.changed, "new": self.intruding}
        return "\n".join(f"{len(lines)} {kind}: {', '.join(sorted(lines)[:8])}" for kind, lines in kinds.items() if lines)

    def __bool__(self) -> bool:
        return bool(self.missing or self.changed or self.intruding)


@dataclass(frozen=True)
class Home:
    """The home at one path, put back in order from a copy after each command.

    `kept` are the user's bytes among gsbake's own files, which may move to another name; `pinned` those that must stay as they are.
    """

    root: Path
    copy: Path
    before: dict[str, Entry]
    kept: frozenset[str]
    pinned: frozenset[str]

    @property
    def user_files(self) -> dict[str, Entry]:
        """Everything that is not gsbake's own."""
        return {name: e for name, e in self.before.items() if not inside(name, "work") or name in self.pinned}

    @property
    def count(self) -> int:
        """Number of the user's files and links, those among gsbake's own included."""
        return sum(not stat.S_ISDIR(entry.mode) for entry in self.user_files.values()) + len(self.kept)

    def restore(self) -> None:
        """Put everything back as it was."""
        shutil.rmtree(self.root)
        shutil.copytree(self.copy, self.root, symlinks=True)

    def damage(self, now: dict[str, Entry], places: tuple[str, ...]) -> Damage:
        """What happened until the snapshot `now`; new files may be in `places`, and in gsbake's own folders."""
        found = Damage()
        for name, entry in self.user_files.items():
            if name not in now:
                found.missing.append(name)
            elif now[name] != entry:
                found.changed.append(name)
        contents = {entry.content for entry in now.values()}
        found.missing += [f"the only copy of {content[:8]}" for content in self.kept if content not in contents]
        for name in now.keys() - self.before.keys():
            if not any(inside(name, place) or inside(place, name) for place in (*places, "work")):
                found.intruding.append(name)
        return found
