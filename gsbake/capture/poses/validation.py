"""Validation of what a pose file says about one frame, shared by all formats.

Every number must be finite and within bounds that no real camera leaves; a file that is larger than any real one is not read at all.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gsbake.errors import BadInputError

#: Largest pose file in bytes: a transforms.json of 100 000 frames has about 100 MB.
MAX_FILE_SIZE = 256 << 20
#: Largest coordinate of a camera or point, in units of the file; beyond it double precision loses the object.
MAX_COORDINATE = 1e9
#: Most frames of a pose file.
MAX_FRAMES = 100_000

Size = Annotated[float, Field(ge=1, le=200_000)]
Focal = Annotated[float, Field(gt=0, le=1e7)]
Principal = Annotated[float, Field(ge=-1e6, le=1e6)]
Angle = Annotated[float, Field(gt=0, lt=math.pi)]
Coefficient = Annotated[float, Field(ge=-1e3, le=1e3)]
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]


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


def validate(model: type[Strict], values: Any, what: str) -> Any:
    """`values` as an instance of `model`. Raises BadInputError that names the first wrong field of `what`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise BadInputError(f"{what} is invalid: {first_error(error)}.") from error
    except (OverflowError, RecursionError) as error:
        raise BadInputError(f"{what} is invalid: a number is too large.") from error


def first_error(error: ValidationError) -> str:
    """The first error of a validation as "field: reason"."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    where = ".".join(map(str, first["loc"]))
    reason = first["msg"][:1].lower() + first["msg"][1:]
    return f"{where}: {reason}" if where else reason
