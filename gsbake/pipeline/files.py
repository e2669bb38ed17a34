"""Copies, folders, and the errors of full, failing or read-only disks."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from contextlib import suppress
from pathlib import Path

from gsbake.atomic import atomic_replacement
from gsbake.errors import BadInputError, GsbakeError, InterruptedRun, UsageError
from gsbake.system.disk import sync

#: errno values of a full disk or quota.
DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
#: errno values of a location without write access.
NOT_WRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})
#: errno values of a name that is taken or cannot be, which trying again does not change.
LASTING = frozenset({errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP})
#: errno values of a path that cannot be used as it is.
_UNUSABLE = NOT_WRITABLE | {errno.ENAMETOOLONG, errno.ELOOP}


def sync_tree(folder: Path) -> None:
    """Flush every file and folder under `folder`, and the folder itself."""
    for root, _, names in os.walk(folder):
        for name in names:
            sync(Path(root) / name)
        sync(Path(root))


def copy_atomic(source: Path, target: Path) -> None:
    """Replace `target` atomically by a copy of `source`."""
    with atomic_replacement(target, durable=True) as temporary:
        shutil.copyfile(source, temporary)


def remove_tree(folder: Path) -> None:
    """Delete a folder; errors are ignored, and the next run removes what is left."""
    shutil.rmtree(folder, ignore_errors=True)


def ensure_output_folder(out: Path) -> None:
    """Create the output folder and check that it is writable. Raises BadInputError or UsageError otherwise."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / f".probe-{uuid.uuid4().hex[:8]}"
        probe.touch()
        probe.unlink()
    except (FileExistsError, NotADirectoryError) as error:
        raise UsageError(f"'{out}' cannot be the output folder: a file of that name exists; choose another with --out.") from error
    except OSError as error:
        raise disk_error(error, out) or BadInputError(
            f"The output folder '{out}' cannot be created ({error.strerror}); choose another with --out."
        ) from error


def disk_error(error: BaseException, folder: Path) -> BadInputError | InterruptedRun | None:
    """The user error for a full or failing disk (InterruptedRun: the same command resumes) or an unwritable output `folder`
    (BadInputError); None for any other `error`.

    Native libraries report a full disk in their own words, so free space is checked too.
    """
    number = error.errno if isinstance(error, OSError) else None
    existing = folder if folder.exists() else folder.parent
    if number in DISK_FULL:
        return _disk_full(folder)
    if number == errno.EIO:
        return InterruptedRun(f"The disk of '{folder}' failed (input/output error); check the disk, then the same command resumes the run.")
    if number in NOT_WRITABLE and isinstance(error, OSError):
        failed = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else folder
        if _related(failed, folder) or number == errno.EROFS:
            return BadInputError(f"The output folder '{folder}' cannot be written ({error.strerror}); choose another with --out.")
    with suppress(OSError):
        usage = shutil.disk_usage(existing)
        if usage.total and usage.free < 1 << 20:
            return _disk_full(folder)
    return None


def path_error(error: OSError) -> GsbakeError | None:
    """The user error of a path that the system refuses (no permission, a read-only disk, a name that is too long, a loop of links) or of a
    full or failing disk; None for any other error, which is a fault of gsbake."""
    if not isinstance(error.filename, str | bytes):
        return None
    path = os.fsdecode(error.filename)
    if error.errno in DISK_FULL or error.errno == errno.EIO:
        return disk_error(error, Path(path).parent)
    if error.errno in _UNUSABLE:
        return BadInputError(f"'{path}' cannot be used ({error.strerror}); change its permissions or name another.")
    return None


def _disk_full(folder: Path) -> InterruptedRun:
    return InterruptedRun(f"The disk of '{folder}' is full; free some space and run the same command, which resumes the run.")


def _related(path: Path, folder: Path) -> bool:
    """Whether `path` is `folder`, is inside it, or is one of its parents."""
    path, folder = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    return path == folder or folder in path.parents or path in folder.parents
