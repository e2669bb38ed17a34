"""Random kills, and truncated, corrupted and deleted files; afterwards the same command gives the same result."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.pipeline.test_engine import total
from tests.pipeline.toy import Sum, Toy, engine

ROOT = Path(__file__).resolve().parents[2]
STEPS = 40

pytestmark = pytest.mark.slow


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.txt").write_text("one two three four")
    return folder


def result(out: Path, photos: Path) -> str:
    states = engine(out, photos, Toy(sum=Sum(steps=STEPS, step_seconds=0.02)))[0].run()
    return (states[2].artifact.folder / "tell.txt").read_text()  # type: ignore[union-attr]


@pytest.mark.parametrize("seed", range(3))
def test_kills_at_random_moments(tmp_path: Path, photos: Path, seed: int) -> None:
    rng = random.Random(seed)
    out = tmp_path / "out"
    for _ in range(8):
        process = subprocess.Popen(
            [sys.executable, "-c", "from tests.pipeline.toy import main; main()", str(out), str(photos), "chain", str(STEPS), "0.02"],
            cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        time.sleep(rng.uniform(0.1, 1.6))
        process.kill()
        process.wait()
    assert result(out, photos) == f"total {total(STEPS, 4)}"
    assert not [p for p in out.rglob("*.tmp*") if not p.name.startswith(".")] and not list(out.rglob("*.lease"))


@pytest.mark.parametrize("seed", range(12))
def test_damage_to_any_file(tmp_path: Path, photos: Path, seed: int) -> None:
    rng = random.Random(seed)
    out = tmp_path / "out"
    result(out, photos)
    victims = sorted(p for p in out.rglob("*") if p.is_file() and p.name not in ("project.json", "events.jsonl"))
    for path in rng.sample(victims, 3):
        data = bytearray(path.read_bytes())
        match rng.choice(("delete", "truncate", "flip")):
            case "delete":
                path.unlink()
            case "truncate":
                path.write_bytes(data[: len(data) // 2])
            case _ if data:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
                path.write_bytes(data)
    assert result(out, photos) == f"total {total(STEPS, 4)}"
