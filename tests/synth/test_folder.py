"""The built-in capture replaces itself, and never a photo of the user's."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from gsbake.errors import UsageError
from gsbake.synth import capture as module
from gsbake.synth.capture import write_capture
from gsbake.synth.folder import MARK


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Toy files in place of renders; the last photo depends on the seed."""

    def write(folder: Path, views: int, size: int, seed: int, poses: bool, *_: object) -> None:
        photos = [f"{view:03d}.png" for view in range(views)]
        truth = [f"truth/{kind}/{photo}" for kind in ("masks", "albedo", "normal", "orm", "emission") for photo in photos]
        files = [*(f"images/{photo}" for photo in photos), *truth, "truth/mesh.ply", "truth/points.npz", "truth/cameras.json"]
        for name in [*files, *(["transforms.json"] if poses else [])]:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(f"{name} {size}")
        (folder / "images" / photos[-1]).write_text(str(seed))

    monkeypatch.setattr(module, "_write", write, raising=False)


def contents(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("quick")
def test_a_capture_of_the_users_is_refused(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name in ("transforms.json", "images/000.png"):
        (tmp_path / name).write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(UsageError, match="holds other files"):
        write_capture(tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("quick")
def test_a_capture_is_written_anew_and_leaves_nothing_of_the_old_one(tmp_path: Path) -> None:
    write_capture(tmp_path, views=5)
    write_capture(tmp_path, views=3, poses=False)
    names = set(contents(tmp_path))
    assert {name for name in names if name.startswith("images")} == {f"images/00{k}.png" for k in range(3)}
    assert "transforms.json" not in names and MARK in names and not any(".synth" in name for name in names)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("name", ["images/001.png", "images/mine.jpg", "notes.txt"])
def test_edited_and_added_files_are_kept(tmp_path: Path, name: str) -> None:
    write_capture(tmp_path)
    (tmp_path / name).write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(UsageError, match="is not as gsbake wrote it") as caught:
        write_capture(tmp_path)
    assert name in str(caught.value).replace("\\", "/") and contents(tmp_path) == before


@pytest.mark.usefixtures("quick")
def test_a_killed_writer_leaves_nothing_that_looks_like_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path, views=4)
    moved: list[Path] = []

    def replace(path: Path, target: Path) -> Path:
        moved.append(target)
        if len(moved) == 9:
            raise KeyboardInterrupt
        return Path(shutil.move(path, target))

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "replace", replace)
        write_capture(tmp_path, views=6, seed=2)
    (tmp_path / ".synth-0a1b2c3d").mkdir()
    write_capture(tmp_path, views=3)
    assert len(list((tmp_path / "images").iterdir())) == 3 and not list(tmp_path.glob(".synth*"))


@pytest.mark.usefixtures("quick")
def test_a_capture_of_an_earlier_version_is_recognised_by_its_layout(tmp_path: Path) -> None:
    write_capture(tmp_path)
    (tmp_path / MARK).unlink()
    write_capture(tmp_path)
    (tmp_path / MARK).unlink()
    (tmp_path / "images" / "000.png").write_text("edited")
    with pytest.raises(UsageError, match="is not as gsbake wrote it"):
        write_capture(tmp_path)
    assert (tmp_path / "images" / "000.png").read_text() == "edited"
