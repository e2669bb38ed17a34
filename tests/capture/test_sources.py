from __future__ import annotations

from pathlib import Path

import pytest

from gsbake.capture.sources import Sources, discover, list_masks, list_photos, require_photo
from gsbake.errors import BadInputError


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_capture_folder(tmp_path: Path) -> None:
    touch(tmp_path / "images/a.JPG", tmp_path / "images/left/b.png", tmp_path / "masks/a.png", tmp_path / "transforms.json")
    found = discover(tmp_path)
    assert found == Sources(tmp_path / "images", tmp_path / "masks", tmp_path / "transforms.json")
    assert [p.name for p in list_photos(found.photos)] == ["a.JPG", "b.png"]


def test_masks_and_poses_of_the_parent_folder(tmp_path: Path) -> None:
    touch(tmp_path / "photos/a.jpg", tmp_path / "masks/a.png", tmp_path / "sparse/0/cameras.bin")
    found = discover(tmp_path / "photos")
    assert found.masks is not None and found.masks.samefile(tmp_path / "masks")
    assert found.poses is not None and found.poses.samefile(tmp_path / "sparse/0")


def test_photos_beside_their_transforms(tmp_path: Path) -> None:
    touch(tmp_path / "a.jpg", tmp_path / "transforms.json", tmp_path / "masks/a.jpg.png")
    assert discover(tmp_path) == Sources(tmp_path, tmp_path / "masks", tmp_path / "transforms.json")


def test_reference_data_is_never_read(tmp_path: Path) -> None:
    touch(tmp_path / "images/a.jpg", tmp_path / "gt/transforms.json", tmp_path / "gt/masks/a.png", tmp_path / "images/gt/b.jpg")
    assert discover(tmp_path) == Sources(tmp_path / "images")
    assert [p.name for p in list_photos(tmp_path / "images")] == ["a.jpg"]


def test_named_folders_override(tmp_path: Path) -> None:
    touch(tmp_path / "images/a.jpg", tmp_path / "masks/a.png", tmp_path / "m/a.png", tmp_path / "p/poses_bounds.npy")
    found = discover(tmp_path, tmp_path / "m", tmp_path / "p")
    assert found == Sources(tmp_path / "images", tmp_path / "m", tmp_path / "p/poses_bounds.npy")


def test_poses_of_a_named_folder(tmp_path: Path) -> None:
    """XMP files are poses only where there are no others: photo editors write them beside photos as well."""
    touch(tmp_path / "images/a.jpg", tmp_path / "xmp/a.xmp", tmp_path / "both/a.XMP", tmp_path / "both/transforms.json")
    touch(tmp_path / "sfm/reconstruction.json", tmp_path / "scan/keyframes/cameras/1.json")
    assert discover(tmp_path, poses=tmp_path / "xmp").poses == tmp_path / "xmp"
    assert discover(tmp_path, poses=tmp_path / "both").poses == tmp_path / "both/transforms.json"
    assert discover(tmp_path, poses=tmp_path / "sfm").poses == tmp_path / "sfm/reconstruction.json"
    for named in (tmp_path / "scan", tmp_path / "scan/keyframes", tmp_path / "scan/keyframes/cameras"):
        assert discover(tmp_path, poses=named).poses == tmp_path / "scan/keyframes/cameras"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        ([], "does not exist"),
        (["cap/readme.txt"], "no photos"),
        (["cap/images/.hidden.jpg"], "no photos"),
    ],
)
def test_bad_folders(tmp_path: Path, make: list[str], words: str) -> None:
    touch(*(tmp_path / m for m in make))
    with pytest.raises(BadInputError, match=words):
        discover(tmp_path / "cap")


def test_a_photo_that_is_not_there(tmp_path: Path) -> None:
    touch(tmp_path / "images/front/a.JPG", tmp_path / "images/b.png", tmp_path / "v.mp4")
    for name in ("front/a.JPG", "a.JPG", "front_a", "b.png", "b"):
        require_photo(tmp_path / "images", name, "export.front")
    with pytest.raises(
        BadInputError, match=r"export\.front names the photo 'c\.png', which is none of the photos \(b\.png, front/a\.JPG\)"
    ):
        require_photo(tmp_path / "images", "c.png", "export.front")
    touch(tmp_path / "images/back/a.JPG", tmp_path / "images/back/b.png")
    with pytest.raises(BadInputError, match=r"'a\.JPG', which are several \(back/a\.JPG, front/a\.JPG\); name it with its folder"):
        require_photo(tmp_path / "images", "a.JPG", "export.front")
    for name in ("back/a.JPG", "b.png"):  # the latter is a path
        require_photo(tmp_path / "images", name, "export.front")
    for absent in (tmp_path / "v.mp4", tmp_path / "moved"):
        require_photo(absent, "c.png", "export.front")


def test_bad_overrides(tmp_path: Path) -> None:
    touch(tmp_path / "images/a.jpg", tmp_path / "poses.txt", tmp_path / "empty/x")
    with pytest.raises(BadInputError, match="mask folder"):
        discover(tmp_path, masks=tmp_path / "nomasks")
    for name, words in (("nope.json", "do not exist"), ("poses.txt", "unknown format"), ("empty", "holds no poses")):
        with pytest.raises(BadInputError, match=words):
            discover(tmp_path, poses=tmp_path / name)
    with pytest.raises(BadInputError, match="is a file"):
        discover(tmp_path / "images/a.jpg")


def test_masks_are_images_inside_their_folder(tmp_path: Path) -> None:
    touch(tmp_path / "masks/left/a.png", tmp_path / "masks/b.jpg.png", tmp_path / "masks/notes.txt", tmp_path / "masks/.c.png")
    touch(tmp_path / "elsewhere/secret.png", tmp_path / "masks/.hidden/d.png")
    (tmp_path / "masks" / "etc").symlink_to(tmp_path / "elsewhere")
    assert list_masks(tmp_path / "masks") == ["b.jpg.png", "left/a.png"]


def test_mask_folder_that_leads_out_of_the_capture_must_be_named(tmp_path: Path) -> None:
    touch(tmp_path / "capture/images/a.jpg", tmp_path / "elsewhere/a.png", tmp_path / "capture/made/a.png")
    link = tmp_path / "capture" / "masks"
    link.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadInputError, match=r"is a link that leads out of the capture.*name it with --masks"):
        discover(tmp_path / "capture")
    assert discover(tmp_path / "capture", masks=link).masks == link
    link.unlink()
    link.symlink_to("made")
    assert discover(tmp_path / "capture").masks == link
