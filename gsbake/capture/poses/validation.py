"""Validation of what a pose file says about one frame, shared by all formats.

Every number must be finite and within bounds that no real camera leaves; a file that is larger than any real one is not read at all.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, TypeVar
from xml.etree import ElementTree
from xml.parsers import expat

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from gsbake.errors import BadInputError
from gsbake.memory_budget import check, json_bytes
from gsbake.text import missing_list

#: Largest pose file in bytes: a transforms.json of 100 000 frames has about 100 MB.
MAX_FILE_SIZE = 256 << 20
#: Largest coordinate of a camera or point, in units of the file; beyond it double precision loses the object.
MAX_COORDINATE = 1e9
#: Bytes that an element or an attribute takes.
XML_BYTES = 400
#: Most frames of a pose file.
MAX_FRAMES = 100_000
#: Most characters of a field's path in a message: keys come from strangers.
MAX_FIELD_NAME = 200
#: Largest effect in pixels at which a coefficient that is not supported is ignored.
NEGLIGIBLE_PIXELS = 0.1

Size = Annotated[float, Field(ge=1, le=200_000)]
Focal = Annotated[float, Field(gt=0, le=1e7)]
Principal = Annotated[float, Field(ge=-1e6, le=1e6)]
Angle = Annotated[float, Field(gt=0, lt=math.pi)]
Coefficient = Annotated[float, Field(ge=-1e3, le=1e3)]
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Vector = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]


class Strict(BaseModel):
    """Base of the models: numbers are numbers (no strings, no booleans), finite; unknown fields are ignored."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, extra="ignore", frozen=True)


class ImportedCamera(Strict):
    """Intrinsics and position of one frame in OpenCV conventions: sizes, focal lengths and principal point in pixels."""

    width: Size
    height: Size
    fx: Focal
    fy: Focal
    cx: Principal
    cy: Principal
    distortion: tuple[Coefficient, ...] = Field(max_length=14)
    translation: tuple[Coordinate, Coordinate, Coordinate]


def check_file_size(path: Path) -> None:
    """Raise BadInputError for a file that is too large to be a pose file, or that cannot be read."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise BadInputError(f"{path} cannot be read ({error.strerror}).") from error
    if size > MAX_FILE_SIZE:
        raise BadInputError(f"{path} has {size / 1e6:.0f} MB; a pose file has at most {MAX_FILE_SIZE / 1e6:.0f} MB.")


def read_file(path: Path, most: int = -1) -> bytes:
    """The content of a pose file, or its first `most` bytes. Raises BadInputError when it is too large or cannot be read."""
    check_file_size(path)
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise BadInputError(f"{path} cannot be read ({error.strerror}).") from error


_Body = TypeVar("_Body")


def read_json_text(path: Path) -> bytes:
    """The content of a JSON file. Raises BadInputError as `read_file`, and when its objects would take more memory than there is."""
    content = read_file(path)
    check(json_bytes(content), str(path))
    return content


def read_json(path: Path, kind: type[_Body], what: str) -> _Body:
    """The content of a JSON file as `kind`, a model or a container of models. Raises BadInputError when it is no valid `what`."""
    try:
        return TypeAdapter(kind).validate_json(read_json_text(path))
    except ValidationError as error:
        raise BadInputError(f"{path} is not a valid {what} ({listed_errors(error)}).") from error


def read_xml(path: Path, what: str) -> ElementTree.Element:
    """The root of an XML file. Raises BadInputError when it is no XML, or has a document type: its entities may expand without end.

    The parser itself says so, whatever the encoding of the file; `ElementTree` has no such handler.
    """
    content = read_file(path)
    check(len(content) + XML_BYTES * content.count(b"<") + XML_BYTES * content.count(b"="), str(path))
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate(None, "}")

    def refuse(*_: object) -> None:
        raise BadInputError(f"{path} declares XML entities, which no {what} does; export it again.")

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(_qualified(tag), {_qualified(name): value for name, value in attributes.items()})

    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.StartElementHandler, parser.CharacterDataHandler = start, builder.data
    parser.EndElementHandler = lambda tag: builder.end(_qualified(tag))
    try:
        parser.Parse(content, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise BadInputError(f"{path} is not a valid XML file ({' '.join(str(error).split())[:200]}).") from error


def _qualified(name: str) -> str:
    """A name as `ElementTree` writes it, "{namespace}name", of one as expat does, "namespace}name"."""
    return "{" + name if "}" in name else name


def refuse_coefficient(coefficient: str, pixels: float, frame: str, source: str) -> None:
    """Raise BadInputError when a `coefficient` without equal here moves the corner of the photo by a visible number of `pixels`."""
    if not abs(pixels) < NEGLIGIBLE_PIXELS:
        raise BadInputError(
            f"The camera of frame {frame} in {source} has a coefficient {coefficient}, which is not supported; undistort the photos, or "
            f"align them without {coefficient}."
        )


def validate(model: type[Strict], values: Any, what: str) -> Any:
    """`values` as an instance of `model`. Raises BadInputError that lists the wrong fields of `what`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise BadInputError(f"{what} is invalid: {listed_errors(error)}.") from error
    except (OverflowError, RecursionError) as error:
        raise BadInputError(f"{what} is invalid: a number is too large.") from error


def listed_errors(error: ValidationError) -> str:
    """The errors of a validation as text, up to ten, then their number."""
    return missing_list(error_lines(error))


def error_lines(error: ValidationError) -> list[str]:
    """The errors of a validation, each as "field: reason"."""
    lines = []
    for found in error.errors(include_url=False, include_context=False, include_input=False):
        where = ".".join(map(str, found["loc"]))[:MAX_FIELD_NAME]
        reason = found["msg"][:1].lower() + found["msg"][1:]
        lines.append(f"{where}: {reason}" if where else reason)
    return lines
