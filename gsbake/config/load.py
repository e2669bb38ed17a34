"""Loading of profiles: TOML files that extend one another, overridden by `--set section.key=value`.

An unknown key is an error that names the nearest valid one; an invalid value is an error that names the allowed ones.

extends = "preview"          # a shipped profile, or a path relative to this file

[train]
iterations = 5000
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from gsbake.config.renamed import present_value
from gsbake.config.schema import Profile
from gsbake.errors import BadInputError, UsageError
from gsbake.text import number

#: Profile without `--profile`.
DEFAULT = "relight"
#: Largest profile in bytes: one with every setting has about 10 kB.
MAX_SIZE = 1_000_000
#: Characters of an invalid value that a message shows.
MAX_VALUE_LENGTH = 60
#: Pydantic's types of errors for values that are no number at all.
_NOT_A_NUMBER = frozenset({"int_parsing", "int_type", "float_parsing", "float_type"})


@dataclass(frozen=True)
class LoadedProfile:
    """A validated profile; `origins` maps each "section.key" to the source of its value ("default", a profile, a file or "--set")."""

    name: str
    profile: Profile
    origins: Mapping[str, str]


def shipped() -> dict[str, Path]:
    """{name: file} of the shipped profiles, in alphabetical order."""
    folder = Path(str(resources.files("gsbake.profiles")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_profile(name: str = DEFAULT, overrides: Sequence[str] = ()) -> LoadedProfile:
    """Load the profile `name` (a shipped one or a TOML file) and apply `overrides` ("section.key=value").

    Raises UsageError for a profile that does not exist or an override without '=', BadInputError for an unknown key or an invalid value,
    with file, key and allowed values. Warns of a value that has a new name (RenamedValueWarning).
    """
    values: dict[str, Any] = {}
    origins: dict[str, str] = {}
    folder = next(iter(shipped().values())).parent
    for path in reversed(_chain(_find(name, None))):
        for key, value in _read(path).items():
            origins[key] = path.stem if path.parent == folder else str(path)
            values[key] = present_value(key, value, origins[key])
    for text in overrides:
        key, value = _parse_override(text)
        _check_key(key, "--set")
        values[key] = present_value(key, value, "--set")
        origins[key] = "--set"
    return LoadedProfile(name, _validate(values, origins), {key: origins.get(key, "default") for key in fields()})


@cache
def fields() -> Mapping[str, FieldInfo]:
    """{"section.key": field} of every setting, and "description"."""
    out: dict[str, FieldInfo] = {}
    for name, info in Profile.model_fields.items():
        section = info.annotation
        if isinstance(section, type) and issubclass(section, BaseModel):
            out.update({f"{name}.{key}": field for key, field in section.model_fields.items()})
        else:
            out[name] = info
    return out


def bounds(field: FieldInfo) -> str:
    """The allowed values of a field in words: "a whole number from 0 to 100", "one of auto, points", "true or false"; "" for any text."""
    kind = field.annotation
    if kind is bool:
        return "true or false"
    if get_origin(kind) is tuple:
        most = next(m.max_length for m in field.metadata if hasattr(m, "max_length"))
        return f"a list of at most {most} {'numbers' if float in get_args(kind) else 'texts'}"
    if choices := get_args(kind):
        words = [word for c in choices for word in (("true", "false") if c is bool else get_args(c) or (c,))]
        return "one of " + ", ".join(str(word) for word in words)
    limits = {name: number(getattr(m, name)) for m in field.metadata for name in ("ge", "gt", "le") if hasattr(m, name)}
    if not limits:
        return ""
    lower = f"from {limits['ge']}" if "ge" in limits else f"above {limits['gt']}, up"
    return f"a {'whole ' if kind is int else ''}number {lower} to {limits['le']}"


def _find(name: str, relative_to: Path | None) -> Path:
    """Path of a profile given by name or path; a path in `extends` is relative to the extending file."""
    known = shipped()
    if name in known:
        return known[name]
    path = Path(name) if relative_to is None else relative_to.parent / name
    for candidate in (path, path.with_name(f"{path.name}.toml")) if Path(name).name else ():
        with suppress(OSError):  # a name that is too long
            if candidate.is_file():
                return candidate
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(known)}, or give a TOML file."
    if relative_to is None:
        raise UsageError(f"There is no profile '{name}': {hint}")
    raise BadInputError(f'{relative_to}: extends = "{name}" names no profile: {hint}')


def _chain(path: Path) -> list[Path]:
    """The file, the one it extends, and so on up to the base."""
    chain: list[Path] = []
    while True:
        if path.resolve() in [p.resolve() for p in chain]:
            raise BadInputError(f"{chain[-1]}: 'extends' forms a cycle through {path.name}.")
        chain.append(path)
        parent = _toml(path).get("extends")
        if parent is None:
            return chain
        if not isinstance(parent, str):
            raise BadInputError(f"{path}: 'extends' must be the name of a profile in quotes, not {parent!r}.")
        path = _find(parent, path)


def _toml(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_SIZE:
            raise BadInputError(f"{path} has {path.stat().st_size / 1e6:.0f} MB; a profile has at most {MAX_SIZE / 1e6:.0f} MB.")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, an integer too long to convert, or nested too deeply
        raise BadInputError(f"{path} is not valid TOML: {error}.") from error
    except OSError as error:
        raise BadInputError(f"{path} cannot be read: {error.strerror}.") from error


def _read(path: Path) -> dict[str, Any]:
    """{"section.key": value} of one file. Raises BadInputError for an unknown key."""
    out: dict[str, Any] = {}
    for name, value in _toml(path).items():
        if name == "extends":
            continue
        if not isinstance(value, dict):
            _check_key(name, str(path))
            out[name] = value
            continue
        for key, inner in value.items():
            _check_key(f"{name}.{key}", str(path))
            out[f"{name}.{key}"] = inner
    return out


def _check_key(key: str, where: str) -> None:
    known = fields()
    if key not in known:
        raise BadInputError(f"{where}: there is no setting '{key}'; {_nearest(key, known)}.")


def _nearest(key: str, known: Iterable[str]) -> str:
    """The most similar key; keys with the same last part first, because the section may be wrong."""
    last = key.rsplit(".", 1)[-1]
    nearest = max((k for k in known if "." in k), key=lambda k: (k.split(".")[1] == last, difflib.SequenceMatcher(None, key, k).ratio()))
    return f"the nearest is '{nearest}'"


def _parse_override(text: str) -> tuple[str, Any]:
    key, equals, raw = text.partition("=")
    key, raw = key.strip(), raw.strip()
    if not equals or not key:
        raise UsageError(f"--set takes section.key=value, not '{text}'.")
    if any("\ud800" <= c <= "\udfff" for c in text):  # bytes of the command line that are no text
        raise UsageError(f"--set takes text, but '{text}' is not valid UTF-8.")
    field = fields().get(key)
    if field is not None and field.annotation is str:
        return key, raw
    try:
        return key, tomllib.loads(f"value = {raw}")["value"]
    except (ValueError, RecursionError):
        return key, raw  # a bare word, as in --set mesh.holes=leave, or a value that TOML cannot convert


def _validate(values: Mapping[str, Any], origins: Mapping[str, str]) -> Profile:
    body: dict[str, Any] = {}
    for key, value in values.items():
        section, dot, name = key.partition(".")
        if dot:
            body.setdefault(section, {})[name] = value
        else:
            body[section] = value
    try:
        return Profile.model_validate(body)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"][:2])
        value = first["input"]
        field = fields().get(key)
        allowed = bounds(field) if field is not None else ""
        text = f"must be {allowed}" if allowed else f"fails with: {first['msg']}"
        if isinstance(value, str) and field is not None:
            near = difflib.get_close_matches(value, [str(c) for c in get_args(field.annotation)], 1)
            text += f" (did you mean '{near[0]}'?)" if near else ""
        if first["type"] == "value_error":  # from a validator of the schema, in its own words
            raise BadInputError(f"{origins.get(key, 'profile')}: {key} = {value!r} is invalid: {first['ctx']['error']}.") from error
        fault = "not a number" if first["type"] in _NOT_A_NUMBER else "invalid"
        shown = repr(value) if len(repr(value)) <= MAX_VALUE_LENGTH else repr(value)[:MAX_VALUE_LENGTH] + "…"
        raise BadInputError(f"{origins.get(key, 'profile')}: {key} = {shown} is {fault}: it {text}.") from error
