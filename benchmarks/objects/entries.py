"""The objects of `objects.toml`: what is rendered, under which light, from which views."""

from __future__ import annotations

import hashlib
import json
import tomllib
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from benchmarks.objects.models import MODELS, model_glb
from gsbake.errors import BadInputError

LIST = Path(__file__).parent / "objects.toml"
TURNTABLE = Path(__file__).parent / "turntable_render.py"


@dataclass(frozen=True)
class Entry:
    """One object: its `model`, the `light` of the photos and those of `relight`, cameras and the `seed` of their positions.

    `mode`, `views`, `resolution`, `samples`, `test_views`, `test_resolution` are options of the scorer's `make_capture.py`; captures on a
    turntable are rendered by `turntable_render.py`. `sha256` is that of a model file.
    """

    name: str
    model: str
    light: str
    relight: tuple[str, ...]
    metal: Literal["none", "neutral", "coloured", "mixed"]
    mode: Literal["posed", "photos", "turntable"]
    views: int
    resolution: tuple[int, int]
    samples: int
    test_views: int
    test_resolution: int
    seed: int
    licence: str = "own"
    sha256: str = ""

    @property
    def key(self) -> str:
        """Digest of everything that the photos depend on; another one needs another render."""
        shown = {k: v for k, v in asdict(self).items() if k not in ("licence", "metal")}
        return hashlib.sha256(json.dumps(shown, sort_keys=True).encode()).hexdigest()[:16]

    def model_bytes(self, shared: Path) -> bytes:
        """The model as GLB; files are read from `shared`. Raises BadInputError for a file with another digest."""
        if self.model in MODELS:
            shape, procedure = MODELS[self.model]
            return model_glb(shape(), procedure)
        data = (shared / self.model).read_bytes()
        if hashlib.sha256(data).hexdigest() != self.sha256:
            raise BadInputError(f"{shared / self.model} is not the file that objects.toml names (other SHA-256); get that one.")
        return data

    def render_command(self, python: Path, model: Path, capture: Path, scorer: Path, lights: Path) -> list[str]:
        """The command that renders `capture`: `scorer` is the folder of `make_capture.py`, `lights` that of the environments."""
        turntable = [str(TURNTABLE), "--scorer", str(scorer)]
        script = turntable if self.mode == "turntable" else [str(scorer / "make_capture.py"), "--mode", self.mode]
        width, height = self.resolution
        return [
            str(python), *script, str(model), str(capture),
            "--views", str(self.views), "--res", str(width), str(height), "--samples", str(self.samples),
            "--test-views", str(self.test_views), "--test-res", str(self.test_resolution), "--seed", str(self.seed),
            "--hdri", str(lights / f"{self.light}.exr"), "--relight", *(str(lights / f"{light}.exr") for light in self.relight),
        ]  # fmt: skip


def read_entries(path: Path = LIST) -> dict[str, Entry]:
    """The entries by name. Raises BadInputError for a key that `Entry` does not have, or one that is missing."""
    data = tomllib.loads(path.read_text())
    known = {f.name for f in fields(Entry)} - {"name"}
    entries = {}
    for name, own in data["objects"].items():
        values: dict[str, Any] = data["defaults"] | own
        if unknown := sorted(set(values) - known):
            raise BadInputError(f"{path}: object {name} has the unknown key {unknown[0]}; known are {', '.join(sorted(known))}.")
        values |= {k: tuple(v) for k, v in values.items() if isinstance(v, list)}
        try:
            entry = Entry(name=name, **values)
        except TypeError as error:
            raise BadInputError(f"{path}: object {name} is not complete ({error}).") from error
        if entry.light in entry.relight:
            raise BadInputError(f"{path}: object {name} is relit by the light of its photos, {entry.light}.")
        entries[name] = entry
    return entries
