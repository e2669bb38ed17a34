"""The key of a stage's output: a digest of everything that may change it, and of nothing else.

Key = BLAKE3 of canonical JSON {format, stage, version, declared settings, content digests of the inputs, backend class, seed}.
Inputs enter by content, not by key: a stage that re-runs and writes the same bytes spares everything after it. Threads, verbosity
and the device's index are not in it. A field at its schema default is left out, so that adding a field changes no old key; the
manifest keeps all values, and a lookup compares them, so that a *changed* default is noticed too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from blake3 import blake3

from gsbake.pipeline.stage import Stage

#: Raised when the way keys are computed changes; every old artifact then counts as unknown.
HASH_FORMAT = 1

#: Characters of the key that name an artifact folder.
SHORT = 16


def canonical(value: Any) -> str:
    """JSON with sorted keys and no spaces; NaN is refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


@dataclass(frozen=True)
class Ingredients:
    """What a key is made of; `settings` holds every declared field, `defaults` what the schema says of each."""

    stage: str
    version: int
    settings: Mapping[str, Any]
    inputs: Mapping[str, str]
    backend: str | None = None
    seed: int | None = None
    defaults: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(
        stage: Stage, settings: Mapping[str, Any], defaults: Mapping[str, Any], inputs: Mapping[str, str], *, device: str, seed: int
    ) -> Ingredients:
        """The ingredients of `stage` with the declared `settings` and the content digests of its `inputs`."""
        return Ingredients(
            stage=stage.name,
            version=stage.version,
            settings=dict(settings),
            inputs=dict(inputs),
            backend=device.split(":")[0] if stage.uses_device else None,
            seed=seed if stage.seeded else None,
            defaults=dict(defaults),
        )

    @property
    def key(self) -> str:
        """The key, 64 hexadecimal digits."""
        chosen = {k: v for k, v in self.settings.items() if k not in self.defaults or self.defaults[k] != v}
        body: dict[str, Any] = {
            "format": HASH_FORMAT,
            "stage": self.stage,
            "version": self.version,
            "settings": chosen,
            "inputs": dict(self.inputs),
        }
        if self.backend is not None:
            body["backend"] = self.backend
        if self.seed is not None:
            body["seed"] = self.seed
        return blake3(canonical(body).encode()).hexdigest()
