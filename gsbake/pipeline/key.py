"""Cache key of a stage's artifact: a digest of everything that can change it, and of nothing else.

Key = BLAKE3 of canonical JSON {format, stage, version, declared settings, content digests of the inputs, backend class, seed}.
Inputs enter by content, not by key: when a stage runs again and writes the same bytes, later stages stay cached (early cut-off). Threads,
verbosity and the device index are not part of the key. Fields at their schema default are omitted, so that a new field changes no existing
key; the manifest stores all values and a look-up compares them, so that a *changed* default is detected too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from blake3 import blake3

from gsbake.pipeline.stage import Stage

#: Version of the key's definition. A new version invalidates all artifacts.
KEY_FORMAT = 1

#: Hexadecimal digits of the key in an artifact folder's name.
KEY_PREFIX_LENGTH = 16


def canonical_json(value: Any) -> str:
    """JSON with sorted keys and without spaces. Raises ValueError for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


@dataclass(frozen=True)
class CacheKey:
    """Components of a key; `settings` holds the value of every declared field, `defaults` its schema default."""

    stage: str
    version: int
    settings: Mapping[str, Any]
    inputs: Mapping[str, str]
    backend: str | None = None
    seed: int | None = None
    defaults: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def for_stage(
        stage: Stage, settings: Mapping[str, Any], defaults: Mapping[str, Any], inputs: Mapping[str, str], *, device: str, seed: int
    ) -> CacheKey:
        """The key of `stage` with its declared `settings` and the content digests of its `inputs`."""
        return CacheKey(
            stage=stage.name,
            version=stage.version,
            settings=dict(settings),
            inputs=dict(inputs),
            backend=device.split(":")[0] if stage.uses_device else None,
            seed=seed if stage.seeded else None,
            defaults=dict(defaults),
        )

    @property
    def digest(self) -> str:
        """The key as 64 hexadecimal digits."""
        non_default = {k: v for k, v in self.settings.items() if k not in self.defaults or self.defaults[k] != v}
        body: dict[str, Any] = {
            "format": KEY_FORMAT,
            "stage": self.stage,
            "version": self.version,
            "settings": non_default,
            "inputs": dict(self.inputs),
        }
        if self.backend is not None:
            body["backend"] = self.backend
        if self.seed is not None:
            body["seed"] = self.seed
        return blake3(canonical_json(body).encode()).hexdigest()
