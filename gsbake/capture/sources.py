"""Discovery of the photos, masks and poses of a capture by conventional file names.

The user names one folder. Only the file names listed here are read, so that reference data beside a capture (such as a `gt/` folder)
stays unused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbake.capture.photos.heic_and_raw import HEIC_SUFFIXES, RAW_SUFFIXES
from gsbake.capture.poses.folder_formats import has_xmp, is_colmap_model
from gsbake.capture.poses.frame_masks import frame_masks, mask_folder
from gsbake.errors import BadInputError
from gsbake.system.names import portable_name
from gsbake.text import shortlist

#: File name suffixes of images, which masks are as well, and of photos.
IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".webp"})
PHOTO_SUFFIXES = IMAGE_SUFFIXES | HEIC_SUFFIXES | RAW_SUFFIXES
#: File name suffixes of videos.
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"})
#: Sub-folders of a capture folder that hold its photos, in order of precedence.
PHOTO_FOLDERS = ("images", "photos")
#: Sub-folders of a photo folder that are skipped.
SKIPPED_FOLDERS = frozenset({"masks", "gt", "sparse", "depths", "depth"})
#: Pose formats that a user may name, for messages.
POSE_FORMATS = (
    "a transforms.json, a COLMAP model folder, a poses_bounds.npy, or cameras of Metashape (XML), RealityScan (CSV, or the folder of its "
    "XMP files), OpenSfM (reconstruction.json), OpenMVG (sfm_data.json) or Polycam (the folder corrected_cameras)"
)
#: File name suffixes of pose files.
POSE_SUFFIXES = frozenset({".json", ".npy", ".xml", ".csv"})
_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
#: Further pose files and folders of a folder that the user names for its poses.
_POLYCAM_FOLDERS = ("corrected_cameras", "cameras")
_NAMED_POSES = ("reconstruction.json", "sfm_data.json", *_POLYCAM_FOLDERS, *(f"keyframes/{name}" for name in _POLYCAM_FOLDERS))


@dataclass(frozen=True)
class Sources:
    """Paths of a capture: the photo folder or video, the mask folder or None, and the pose file or folder or None."""

    photos: Path
    masks: Path | None = None
    poses: Path | None = None


def is_video(path: Path) -> bool:
    """Whether a path is a video file by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def source_files(source: Path) -> list[str]:
    """Names of the photos of a folder, relative to it, or of the video. Raises BadInputError as `list_photos`."""
    return [source.name] if is_video(source) else [path.relative_to(source).as_posix() for path in list_photos(source)]


def require_photo(source: Path, photo: str, what: str) -> None:
    """Raise BadInputError, which says `what` names it, where `photo` is none of the photos of the folder: neither a path, nor a file's
    name, nor the name that it gets; or where files of several folders have the name. Frames of a video have names once they are read; a
    folder that is gone has none to compare with."""
    if source.is_dir():
        files = source_files(source)
        if not any(photo in (name, name.rsplit("/", 1)[-1], portable_name(name.rsplit(".", 1)[0].replace("/", "_"))) for name in files):
            raise BadInputError(f"{what} names the photo '{photo}', which is none of the photos ({shortlist(files)}).")
        same = [name for name in files if name.rsplit("/", 1)[-1] == photo]
        if photo not in files and len(same) > 1:
            raise BadInputError(f"{what} names the photo '{photo}', which are several ({shortlist(same)}); name it with its folder.")


def reads_subfolders(folder: Path) -> bool:
    """Whether photos in the subfolders of a folder of photos count: those of a capture's folder `images` or `photos`."""
    return folder.is_dir() and folder.name in PHOTO_FOLDERS


def list_photos(folder: Path) -> list[Path]:
    """Photos of a folder, sorted by path; including sub-folders when the folder is called `images` or `photos`.

    Of a photo that a camera wrote both as RAW and as an image, the image is taken.
    Raises BadInputError when the folder does not exist or holds no photo.
    """
    if not folder.is_dir():
        kind = "is a file, not a folder" if folder.exists() else "does not exist"
        raise BadInputError(f"The photo folder {folder} {kind}; give the folder that holds the photos, or a video (mp4, mov, …).")
    pattern = "**/*" if reads_subfolders(folder) else "*"
    found = [
        path
        for path in folder.glob(pattern)
        if path.suffix.lower() in PHOTO_SUFFIXES
        and not path.name.startswith(".")
        and not SKIPPED_FOLDERS.intersection(path.relative_to(folder).parts[:-1])
        and path.is_file()
    ]
    if not found:
        kinds = ", ".join(sorted(s[1:] for s in IMAGE_SUFFIXES | HEIC_SUFFIXES)) + " or a camera's RAW"
        raise BadInputError(f"The folder {folder} holds no photos ({kinds}); give the folder that holds them.")
    images = {path.with_suffix("") for path in found if path.suffix.lower() not in RAW_SUFFIXES}
    return sorted(path for path in found if path.suffix.lower() not in RAW_SUFFIXES or path.with_suffix("") not in images)


def list_masks(folder: Path) -> list[str]:
    """Images of a mask folder as sorted relative POSIX names, those of sub-folders included; links to folders are not followed."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    return sorted(name.as_posix() for name in found if not any(part.startswith(".") for part in name.parts))


def find_poses(folder: Path) -> Path | None:
    """The pose file or COLMAP model folder inside `folder`, or None: transforms.json, a sparse model, poses_bounds.npy."""
    if (folder / "transforms.json").is_file():
        return folder / "transforms.json"
    for name in _MODEL_FOLDERS:
        if is_colmap_model(folder / name):
            return folder / name
    if (folder / "poses_bounds.npy").is_file():
        return folder / "poses_bounds.npy"
    return None


def _given_poses(path: Path) -> Path:
    """The pose file of a path given by the user, which may be the folder that holds it."""
    if not path.exists():
        raise BadInputError(f"The poses {path} do not exist; give {POSE_FORMATS}.")
    if path.is_dir():
        found = path if is_colmap_model(path) else find_poses(path)
        if found is None and (has_xmp(path) or (path.name in _POLYCAM_FOLDERS and any(path.glob("*.json")))):
            found = path
        found = found or next((path / name for name in _NAMED_POSES if (path / name).exists()), None)
        if found is None:
            raise BadInputError(f"The folder {path} holds no poses; give {POSE_FORMATS}.")
        return found
    if path.suffix.lower() not in POSE_SUFFIXES:
        raise BadInputError(f"The poses {path} have an unknown format; give {POSE_FORMATS}.")
    return path


def _find_masks(folders: Sequence[Path], poses: Path | None) -> Path | None:
    """The folder of the masks that frames of the poses name, else the folder `masks` of the first of `folders` that has one."""
    masks, named = next((f / "masks" for f in folders if (f / "masks").is_dir()), None), frame_masks(poses)
    if named and (masks is None or not all(path.is_relative_to(masks.resolve()) for path in named.values())):
        return mask_folder(named)
    if masks is not None and folders[-1].resolve() not in masks.resolve().parents:
        raise BadInputError(
            f"The mask folder {masks} is a link that leads out of the capture, to {masks.resolve()}; if that is meant, name it with "
            "--masks."
        )
    return masks


def discover(photos: Path, masks: Path | None = None, poses: Path | None = None) -> Sources:
    """Find the paths of a capture.

    `photos` is a capture folder (photos in `images/` or `photos/`, beside them `masks/` and poses), the photo folder itself, or a video,
    which has neither masks nor poses but those given. Masks and poses are looked for in the photo folder, then in its parent; `masks` and
    `poses` override what is found; masks that the frames of a transforms.json name come before a folder `masks`. Raises BadInputError when
    a given path does not exist, there is no photo, or masks that were found lie elsewhere, behind a link or ".." in a name.
    """
    photos, folders = Path(photos), []
    if photos.is_dir():
        inner = next((photos / name for name in PHOTO_FOLDERS if (photos / name).is_dir()), None)
        if inner is not None:
            photos, folders = inner, [inner, photos]
        else:
            folders = [photos, photos.resolve().parent]
    if not is_video(photos):
        list_photos(photos)
    found = next((p for f in folders if (p := find_poses(f)) is not None), None) if poses is None else _given_poses(Path(poses))
    if masks is None:
        masks = _find_masks(folders, found)
    elif not Path(masks).is_dir():
        raise BadInputError(f"The mask folder {masks} does not exist.")
    return Sources(photos, None if masks is None else Path(masks), found)
