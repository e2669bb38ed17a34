"""Checkpoints: state goes round unchanged, damage is noticed, and the stages that own them start over."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
import torch

from gsbake.checkpoint import DamagedCheckpointError, is_sealed, load_checkpoint, save_checkpoint, seal_file


def test_state_goes_round(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(3)
    table = torch.arange(6.0).reshape(2, 3)
    state = {
        "a": table, "same": table, "view": table.T, "none": None, "number": 0.1, "nan": math.nan, "text": "é\n", "flag": True, "empty": {},
        "list": [1, (torch.zeros(0), 2.5)], "generator": generator.get_state(), "double": torch.tensor([1e-300], dtype=torch.float64),
    }  # fmt: skip
    save_checkpoint(tmp_path / "x", state)
    again = load_checkpoint(tmp_path / "x")
    assert list(again) == list(state) and torch.equal(again["view"], table.T) and again["view"].dtype == torch.float32
    assert again["number"] == 0.1 and math.isnan(again["nan"]) and again["text"] == "é\n" and again["flag"] is True
    assert again["list"][0] == 1 and again["list"][1][1] == 2.5 and len(again["list"][1][0]) == 0 and again["empty"] == {}
    assert torch.equal(again["generator"], state["generator"]) and again["double"].item() == 1e-300
    with pytest.raises(TypeError):
        save_checkpoint(tmp_path / "y", {"x": object()})


def test_any_damage_is_noticed(tmp_path: Path) -> None:
    path, rng = tmp_path / "x", random.Random(0)
    save_checkpoint(path, {"a": torch.arange(100), "b": "text"})
    whole = path.read_bytes()
    for _ in range(200):
        data = bytearray(whole)
        if rng.random() < 0.5:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        else:
            data = data[: rng.randrange(len(data))]
        path.write_bytes(bytes(data))
        with pytest.raises(DamagedCheckpointError) as caught:
            load_checkpoint(path)
        assert "weights_only" not in str(caught.value)
    path.unlink()
    with pytest.raises(DamagedCheckpointError):
        load_checkpoint(path)


def test_sealed_files(tmp_path: Path) -> None:
    path = tmp_path / "planes.npy"
    path.write_bytes(b"planes")
    assert not is_sealed(path)
    seal_file(path)
    assert is_sealed(path)
    path.write_bytes(b"plane5")
    assert not is_sealed(path)
