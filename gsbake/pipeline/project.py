"""Inputs and options of a run, stored in OUT/project.json, so that later commands need only `--out`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import ConfigDict, TypeAdapter, ValidationError

from gsbake.atomic import write_atomic
from gsbake.errors import BadInputError

PROJECT = "project.json"


@dataclass(frozen=True)
class Project:
    """The user's paths (absolute) and options. `published` holds {file in OUT: content digest} of the published results."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    photos: str | None = None
    masks: str | None = None
    poses: str | None = None
    profile: str | None = None
    overrides: tuple[str, ...] = ()
    seed: int = 0
    published: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def load(out: Path) -> Project | None:
        """The project of an output folder; None when there is none. Raises BadInputError when it cannot be read."""
        path = out / PROJECT
        try:
            return TypeAdapter(Project).validate_python(json.loads(path.read_bytes()))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False, include_input=False)[0]
            where = ".".join(map(str, first["loc"])) or "the file"
            raise BadInputError(
                f"'{path}' is damaged or not gsbake's ({where}: {first['msg']}); name another folder, "
                "or move it away and give the photos again."
            ) from error
        except (OSError, ValueError, RecursionError) as error:
            raise BadInputError(
                f"'{path}' cannot be read ({error}); name another folder, or move it away and give the photos again."
            ) from error

    def save(self, out: Path) -> None:
        """Write the file if its content changes."""
        text = json.dumps(asdict(self), indent=1)
        path = out / PROJECT
        if not path.exists() or path.read_bytes() != text.encode():
            write_atomic(path, text)

    def sources(self) -> dict[str, Path]:
        """{"photos" | "masks" | "poses": path} of the paths given."""
        given = {"photos": self.photos, "masks": self.masks, "poses": self.poses}
        return {name: Path(path) for name, path in given.items() if path is not None}
