"""Credentials in the address of a shared store: what is shown and stored is the address without them.

`sftp://user:secret@host/path`, `s3://key:secret@bucket/path`, `…?token=secret`. Only the connection itself takes the whole address. A user
without a password stays for SFTP, where it is part of the address; a user in any other URL may be a token.
"""

from __future__ import annotations

import re
from urllib.parse import parse_qsl, unquote

#: Variable with the address of the store, credentials and all, for the processes of other machines.
VARIABLE = "GSBAKE_STORE"
#: What stands in a text where a credential was.
_HIDDEN = "***"
#: Characters of a part of a password that is hidden too: a parser that takes "/" for the end of a port quotes what it read.
_SHORTEST_PART = 3


def public_url(url: str) -> str:
    """The address without user and password, and without the query of a URL. A folder is returned as it is."""
    protocol, user, _, rest = _parts(url)
    return url if not protocol else f"{protocol}://{user}{rest}"


def has_credentials(url: str | None) -> bool:
    """Whether the address holds something that may not be shown or stored."""
    return url is not None and public_url(url) != url


def hide_credentials(text: str, url: str) -> str:
    """A text about the store, such as a library's message, without the credentials of `url`, as they stand there or decoded."""
    text = text.replace(url, public_url(url))
    for secret in sorted(_parts(url)[2], key=len, reverse=True):
        text = text.replace(secret, _HIDDEN)
    return text


def _parts(url: str) -> tuple[str, str, set[str], str]:
    """(protocol, the user with "@" that may be shown, texts that may not, address without both); no protocol for a folder."""
    protocol, mark, rest = url.partition("://")
    if not mark or protocol in ("file", "local"):
        return "", "", set(), url
    address, _, query = rest.partition("?") if "@" not in rest.partition("?")[2] else (rest, "", "")
    user, at, address = _split_user(address, ports=protocol in ("sftp", "ssh"))
    name, colon, password = user.partition(":")
    shown = bool(at) and not colon and protocol in ("sftp", "ssh")
    secrets = {query, *(value for _, value in parse_qsl(query))} | ({password} if colon else set() if shown else {name})
    secrets |= {unquote(secret) for secret in secrets} | ({f"{user}@"} if at and not shown else set())
    secrets |= {part for secret in secrets for part in re.split("[/?#@:]", secret) if len(part) >= _SHORTEST_PART}
    return protocol, f"{name}@" if shown else "", secrets - {""}, address


def _split_user(address: str, ports: bool) -> tuple[str, str, str]:
    """(user and password, "@", the rest). A password may hold "/" or "@" that nobody encoded."""
    authority = re.split("[/?#]", address, maxsplit=1)[0]
    if "@" not in authority and (":" not in authority or (ports and re.fullmatch(r"\[[^\]]*\](:\d*)?|[^:]*:\d*", authority))):
        return "", "", address
    user, at, host = authority.rpartition("@")
    if at and (":" not in user or "@" not in address[len(authority) :]):
        return user, at, host + address[len(authority) :]
    return address.rpartition("@")
