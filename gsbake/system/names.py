"""Names of files that every system accepts, made from names that one of them gave.

Windows refuses some characters and some names, and with macOS does not tell capitals from small letters. What gsbake calls a file must not
depend on the system it runs on, so the rules of all are kept on each.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable

from blake3 import blake3

#: Longest name in bytes; file systems allow 255, and suffixes are added. Windows allows 260 characters of a whole path.
MAX_NAME_BYTES = 200
#: Longest name in bytes, with its suffix, and longest path of names inside a folder.
_MAX_FILE_BYTES, _MAX_PATH_BYTES = 255, 1024
#: A BLAKE3 digest in lower-case hexadecimal digits.
_DIGEST = re.compile(r"[0-9a-f]{64}")
#: Characters that Windows has no names with.
_REFUSED = frozenset('<>:"/\\|?*')
#: Names of devices of Windows, also with a suffix ("aux.png").
_DEVICES = frozenset({"CON", "PRN", "AUX", "NUL", *(f"{device}{digit}" for device in ("COM", "LPT") for digit in "123456789¹²³")})
#: Characters that are kept of a name that is changed.
_KEPT = 40


def portable_name(name: str) -> str:
    """`name` itself where it can be a file's name on every system, else one with its readable part and a digest."""
    data = os.fsencode(name)
    if _is_portable(name, MAX_NAME_BYTES):
        return name
    safe = "".join(c if c.isprintable() and c not in _REFUSED else "_" for c in name)[:_KEPT]
    return f"{'_' if _is_device(name) else ''}{safe}_{blake3(data).hexdigest()[:12]}"


def unusable_name(names: Iterable[object]) -> str | None:
    """The first of `names` (relative, with "/") that cannot be a file inside one folder together with the others, as `repr`; None where
    all can.

    For names that come from a manifest, a project file or a shared store: each part is a portable name, so none is empty, absolute, too
    long, "..", or has control characters; and no file is the folder of another.
    """
    found: set[str] = set()
    for name in names:
        parts = name.split("/") if isinstance(name, str) else []
        if not isinstance(name, str) or len(name) > _MAX_PATH_BYTES or not all(_is_portable(part, _MAX_FILE_BYTES) for part in parts):
            return repr(name)[:_KEPT]
        found.add(name)
    folders = {name[:at] for name in found for at, character in enumerate(name) if character == "/"}
    both = sorted(found & folders)
    return repr(both[0])[:_KEPT] if both else None


def is_digest(value: object) -> bool:
    """Whether a value from outside is a BLAKE3 digest, and so may become a path: 64 hexadecimal digits."""
    return isinstance(value, str) and _DIGEST.fullmatch(value) is not None


def same_file_key(name: str) -> str:
    """What two names have in common that are one file on some system: they differ in capitals or in how accents are encoded."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _is_portable(name: str, most_bytes: int) -> bool:
    if not name.isprintable() or _REFUSED & set(name) or not _ends_well(name) or _is_device(name):
        return False
    return len(os.fsencode(name)) <= most_bytes


def _ends_well(name: str) -> bool:
    return bool(name) and name[-1] not in ". "


def _is_device(name: str) -> bool:
    return name.partition(".")[0].rstrip(" ").upper() in _DEVICES
