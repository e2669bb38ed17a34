"""New photos and videos of a capture: streamed to the disk in pieces that go on where they stopped, with names and sizes checked.

A file that is not complete is `.name.part` beside the others, which no command reads. It gets its name when the last byte is there.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from gsbake.capture.sources import PHOTO_FOLDERS, PHOTO_SUFFIXES, VIDEO_SUFFIXES
from gsbake.errors import BadInputError, GsbakeError, UsageError
from gsbake.studio.answers import Call, document, refusal
from gsbake.studio.workspace import PHOTOS, Capture
from gsbake.system.names import same_file_key, unusable_name

#: Largest photo and video in bytes, most files of a capture, and bytes that stay free on the disk.
MAX_PHOTO, MAX_VIDEO, MAX_FILES, SPARE = 1_000_000_000, 50_000_000_000, 10_000, 1_000_000_000

#: Files that a request is writing to.
_WRITTEN: set[Path] = set()


def received(call: Call) -> dict[str, int]:
    """Bytes of a file that are there already."""
    target, part = _places(call.capture, call.path["file"])
    found = target if target.exists() else part
    return {"bytes": found.stat().st_size if found.exists() else 0, "complete": int(target.exists())}


async def receive(request: Request) -> Response:
    """Append the body to a file from `offset` on; with it the file is complete when it has `size` bytes."""
    try:
        capture = request.app.state.workspace.capture(request.path_params["capture"])
        offset, size = (int(request.query_params.get(name, "-1")) for name in ("offset", "size"))
        return document(await _append(request, capture, request.path_params["file"], offset, size))
    except GsbakeError as error:
        return refusal(error)
    except ValueError:
        return refusal(UsageError("The request lacks 'offset' and 'size'."))
    except ClientDisconnect:
        return Response(status_code=400)
    except OSError as error:
        return refusal(BadInputError(f"The file cannot be written ({error.strerror})."))


async def _append(request: Request, capture: Capture, name: str, offset: int, size: int) -> dict[str, int]:
    target, part = _places(capture, name)
    most = MAX_VIDEO if target.suffix.lower() in VIDEO_SUFFIXES else MAX_PHOTO
    if not 0 <= offset <= size <= most or not size:
        raise UsageError(f"'{name}' is empty or has more than {most / 1e9:g} GB.")
    if target.exists():
        raise UsageError(f"There is already a file '{name}' in {capture.name}; rename yours.")
    target.parent.mkdir(parents=True, exist_ok=True)
    _check_room(target.parent, name, size - offset)
    with _alone(part, name), part.open("ab") as file:
        have = file.tell()
        if have != offset:
            raise UsageError(f"{have} bytes of '{name}' are there, so it goes on at {have}, not at {offset}.")
        async for piece in request.stream():
            have += len(piece)
            if have > size:
                file.truncate(offset)
                raise UsageError(f"'{name}' has more than the {size} bytes that were announced.")
            file.write(piece)
    if have == size:
        os.replace(part, target)
    return {"bytes": have, "complete": int(have == size)}


@contextmanager
def _alone(part: Path, name: str) -> Iterator[None]:
    """While one request writes to a file, no other does. Raises UsageError for a second one, and for what is no ordinary file."""
    if part in _WRITTEN:
        raise UsageError(f"'{name}' is being uploaded by another page.")
    if part.is_symlink() or (part.exists() and not part.is_file()):
        raise UsageError(f"'{part.name}' is in the way of '{name}' and no file of the studio; remove it.")
    _WRITTEN.add(part)
    try:
        yield
    finally:
        _WRITTEN.discard(part)


def _places(capture: Capture, name: str) -> tuple[Path, Path]:
    """Where a file of this name comes to lie, and where it lies until it is complete. Raises UsageError for a name that cannot be one."""
    suffix = Path(name).suffix.lower()
    if unusable_name([name, f".{name}.part"]) is not None or "/" in name or name.startswith("."):
        raise UsageError(f"'{name[:80]}' cannot be the name of a file on every system; rename it.")
    if suffix not in PHOTO_SUFFIXES | VIDEO_SUFFIXES:
        raise UsageError(f"'{name[:80]}' is neither a photo nor a video (jpg, png, heic, tif, exr, webp, RAW; mp4, mov, …).")
    folder = next((capture.folder / inner for inner in PHOTO_FOLDERS if (capture.folder / inner).is_dir()), capture.folder)
    if suffix in VIDEO_SUFFIXES and folder.name == PHOTOS:
        folder = folder.parent
    return folder / name, folder / f".{name}.part"


def _check_room(folder: Path, name: str, more: int) -> None:
    """Raise UsageError for too many files or too little room, BadInputError never: the disk may be cleaned."""
    names = [path.name for path in folder.iterdir()]
    if len(names) >= MAX_FILES:
        raise UsageError(f"The capture has {len(names)} files; more than {MAX_FILES} are not taken.")
    if any(same_file_key(other) == same_file_key(name) for other in names):
        raise UsageError(f"There is already a file '{name}' up to capitals; rename yours.")
    if shutil.disk_usage(folder).free < more + SPARE:
        raise UsageError(f"The disk has no room for '{name}'.")
