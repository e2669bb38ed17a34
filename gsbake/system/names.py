"""Names of files that every system accepts, made from names that one of them gave.

Windows refuses some characters and some names, and with macOS does not tell capitals from small letters. What gsbake calls a file must not
depend on the system it runs on, so the rules of all are kept on each.
"""

from __future__ import annotations

import os
import unicodedata

from blake3 import blake3

#: Longest name in bytes; file systems allow 255, and suffixes are added. Windows allows 260 characters of a whole path.
MAX_NAME_BYTES = 200
#: Characters that Windows has no names with.
_REFUSED = frozenset('<>:"/\\|?*')
#: Names of devices of Windows, also with a suffix ("aux.png").
_DEVICES = frozenset({"CON", "PRN", "AUX", "NUL", *(f"{device}{digit}" for device in ("COM", "LPT") for digit in "123456789¹²³")})
#: Characters that are kept of a name that is changed.
_KEPT = 40


def portable_name(name: str) -> str:
    """`name` itself where it can be a file's name on every system, else one with its readable part and a digest."""
    data = os.fsencode(name)
    if name.isprintable() and len(data) <= MAX_NAME_BYTES and not _REFUSED & set(name) and _ends_well(name) and not _is_device(name):
        return name
    safe = "".join(c if c.isprintable() and c not in _REFUSED else "_" for c in name)[:_KEPT]
    return f"{'_' if _is_device(name) else ''}{safe}_{blake3(data).hexdigest()[:12]}"


def same_file_key(name: str) -> str:
    """What two names have in common that are one file on some system: they differ in capitals or in how accents are encoded."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _ends_well(name: str) -> bool:
    return bool(name) and name[-1] not in ". "


def _is_device(name: str) -> bool:
    return name.partition(".")[0].rstrip(" ").upper() in _DEVICES
