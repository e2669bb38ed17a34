"""Checkpoint files: nested state of tensors and plain values as safetensors with a digest, and digests beside files of other formats.

A checkpoint is written beside the old one, flushed and renamed. One that cannot be read, or whose digest is wrong, is reported as such:
its owner starts over. Nothing in a checkpoint is executed (no pickle).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from blake3 import blake3
from safetensors import SafetensorError
from safetensors.torch import load, save

from gsbake.atomic import write_atomic
from gsbake.system.disk import sync

_TENSOR = "tensor"
_STRUCTURE = "structure"
_DIGEST_SIZE = 32


class DamagedCheckpointError(Exception):
    """A checkpoint that cannot be used; the message says why."""


def save_checkpoint(path: Path, state: Any) -> None:
    """Write nested dicts (with string keys), lists and tuples of tensors, numbers, strings and None; tuples are read back as lists."""
    tensors: dict[str, torch.Tensor] = {}
    structure = _flatten(state, tensors)
    body = save(tensors, {_STRUCTURE: json.dumps(structure)})
    write_atomic(path, blake3(body).digest() + body, durable=True)


def load_checkpoint(path: Path) -> Any:
    """Read what `save_checkpoint` wrote. Raises DamagedCheckpointError."""
    try:
        data = path.read_bytes()
        body = data[_DIGEST_SIZE:]
        if blake3(body).digest() != data[:_DIGEST_SIZE]:
            raise DamagedCheckpointError("its digest is wrong")
        length = int.from_bytes(body[:8], "little")
        structure = json.loads(json.loads(body[8 : 8 + length])["__metadata__"][_STRUCTURE])
        return _restore(structure, load(body))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, SafetensorError) as error:
        raise DamagedCheckpointError(" ".join(str(error).split())[:200]) from error


def seal_file(path: Path) -> None:
    """Write the digest of a finished file beside it; the file is flushed first."""
    sync(path)
    write_atomic(_seal_path(path), blake3(path.read_bytes()).digest(), durable=True)


def is_sealed(path: Path) -> bool:
    """Whether the file is the one that `seal_file` saw."""
    try:
        return blake3(path.read_bytes()).digest() == _seal_path(path).read_bytes()
    except OSError:
        return False


def _seal_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.digest")


def _flatten(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().clone().contiguous()
        return {_TENSOR: name}
    if isinstance(value, dict):
        return {"items": [[key, _flatten(entry, tensors)] for key, entry in value.items()]}
    if isinstance(value, list | tuple):
        return [_flatten(entry, tensors) for entry in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a checkpoint cannot hold a {type(value).__name__}")


def _restore(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, dict):
        if _TENSOR in value:
            return tensors[value[_TENSOR]]
        return {key: _restore(entry, tensors) for key, entry in value["items"]}
    return [_restore(entry, tensors) for entry in value] if isinstance(value, list) else value
