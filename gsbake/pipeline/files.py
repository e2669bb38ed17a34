"""Writing so that a crash at any instant leaves the old content or the new, never half of one."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from contextlib import suppress
from pathlib import Path

from gsbake.errors import BadInputError, UsageError

#: errno values that mean the disk (or the quota) is full.
FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
#: errno values that mean the place cannot be written at all.
LOCKED = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})


def sync(path: Path) -> None:
    """Flush a file or folder to the disk; file systems that cannot flush a folder are let off."""
    handle = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Flush every file and folder under `folder`, and the folder itself."""
    for root, _, names in os.walk(folder):
        for name in names:
            sync(Path(root) / name)
        sync(Path(root))


def write_atomic(path: Path, text: str, *, durable: bool = False) -> None:
    """Replace `path` by `text` in one step; `durable` also waits for the disk."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        if durable:
            sync(temporary)
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def copy_atomic(source: Path, target: Path) -> None:
    """Replace `target` by a copy of `source` in one step."""
    temporary = target.with_name(f".{target.name}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        shutil.copyfile(source, temporary)
        sync(temporary)
        temporary.replace(target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def remove_tree(folder: Path) -> None:
    """Delete a folder as far as that is possible; a left-over is swept by the next run."""
    shutil.rmtree(folder, ignore_errors=True)


def open_output(out: Path) -> None:
    """Make the output folder if need be, and try whether it can be written; BadInputError or UsageError when it cannot."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / f".probe-{uuid.uuid4().hex[:8]}"
        probe.touch()
        probe.unlink()
    except (FileExistsError, NotADirectoryError) as error:
        raise UsageError(f"'{out}' cannot be the output folder: a file of that name is in the way.") from error
    except OSError as error:
        raise disk_error(error, out) or BadInputError(
            f"The output folder '{out}' cannot be made ({error.strerror}); choose another with --out."
        ) from error


def disk_error(error: BaseException, place: Path) -> BadInputError | None:
    """The sentence for a full or unwritable disk, or None when `error` is neither.

    A native library may report a full disk in words of its own, so free space is looked at as well.
    """
    number = error.errno if isinstance(error, OSError) else None
    where = place if place.exists() else place.parent
    if number in FULL:
        return _disk_full(place)
    if number in LOCKED and isinstance(error, OSError):
        named = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else place
        if _within(named, place) or number == errno.EROFS:
            return BadInputError(f"The output folder '{place}' cannot be written ({error.strerror}); choose another with --out.")
    with suppress(OSError):
        usage = shutil.disk_usage(where)
        if usage.total and usage.free < 1 << 20:
            return _disk_full(place)
    return None


def _disk_full(place: Path) -> BadInputError:
    return BadInputError(f"The disk that holds '{place}' is full; free some space and run the same command, which goes on from here.")


def _within(path: Path, place: Path) -> bool:
    """Whether `path` is `place`, lies in it, or is one of the folders it would be made in."""
    path, place = Path(os.path.abspath(path)), Path(os.path.abspath(place))
    return path == place or place in path.parents or path in place.parents
