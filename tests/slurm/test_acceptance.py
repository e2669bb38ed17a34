"""Twelve built-in captures of different seeds: through Slurm with two nodes of which one is killed, again when all is cached, with one
photo more, and from a shared store with fifty planted corruptions. Prints its figures.
"""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from gsbake.pipeline.shared_store import open_shared_store
from tests.pipeline.test_shared_store import plant_damage
from tests.slurm.batches import PROFILE, Batch, digests, events, gsbake, stages, start_batch, write_captures
from tests.slurm.cluster import Cluster

pytestmark = [pytest.mark.stress, pytest.mark.timeout(12 * 3600)]
COUNT, DAMAGED = 12, 50


@dataclass(frozen=True)
class Farm:
    """The captures, the digests of plain runs, and the shared store that those filled; `later` is a photo that the first capture lacks."""

    captures: list[Path]
    plain: dict[str, dict[str, str]]
    store: Path
    later: Path


@pytest.fixture(scope="module")
def farm(reference: Path) -> Farm:
    root = reference / "twelve"
    captures = write_captures(root / "captures", COUNT)
    full = root / "full.json"
    if not full.exists():
        full.write_text((captures[0] / "transforms.json").read_text())
    body = json.loads(full.read_text())
    left_out = body["frames"].pop()
    later = root / Path(left_out["file_path"]).name
    if not later.exists():
        (captures[0] / left_out["file_path"]).rename(later)
    (captures[0] / left_out["file_path"]).unlink(missing_ok=True)
    (captures[0] / "transforms.json").write_text(json.dumps(body))
    for path in captures:
        plain_run(path, root / "plain" / path.name, "--store", root / "store")
    return Farm(captures, {path.name: digests(root / "plain" / path.name) for path in captures}, root / "store", later)


def plain_run(capture: Path, out: Path, *more: object) -> None:
    gsbake("run", capture, "--out", out, "--profile", PROFILE, "--threads", 1, "--quiet", *more)


def tell(capsys: pytest.CaptureFixture[str], text: str) -> None:
    with capsys.disabled():
        sys.stdout.write(f"\n{text}\n")


def test_twelve_captures_through_slurm(farm: Farm, cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    batch = start_batch(farm.captures, tmp_path / "out", cluster.environment, settings=())
    batch.wait_until("the fourth asset", lambda: len(list(batch.root.glob("*/asset.glb"))) >= 4)
    batch.wait_until("a stage in progress", lambda: any(batch.runs(path, "mesh") for path in farm.captures))
    node = next(name for name in cluster.nodes if cluster.running_on(name))
    cluster.kill_node(node)
    batch.finish()
    lost = batch.check(farm.plain)
    tell(capsys, f"{COUNT} assets with the bytes of plain runs; {node} killed, {lost} stages lost with it, no other stage computed twice")

    before = {path.name: len(stages(batch.root / path.name, "stage started")) for path in farm.captures}
    begin = time.perf_counter()
    again = start_batch(farm.captures, batch.root, cluster.environment, settings=())
    again.finish()
    tell(capsys, f"the same batch again: {time.perf_counter() - begin:.1f} s, {again.output().strip().splitlines()[-1]}")
    assert started(again, farm.captures) == before

    with one_photo_more(farm):
        more = start_batch(farm.captures, batch.root, cluster.environment, settings=())
        more.finish()
        plain_run(farm.captures[0], tmp_path / "plain")
    after = started(more, farm.captures)
    tell(capsys, f"one photo more: stages run by capture {[after[p.name] - before[p.name] for p in farm.captures]}")
    assert after[farm.captures[0].name] > before[farm.captures[0].name]
    assert {name: count for name, count in after.items() if name != farm.captures[0].name} == {
        name: count for name, count in before.items() if name != farm.captures[0].name
    }
    assert set(digests(tmp_path / "plain").values()) <= set(digests(batch.root / farm.captures[0].name).values())


@contextmanager
def one_photo_more(farm: Farm) -> Iterator[None]:
    """The first capture with the photo that it lacks, and its pose."""
    photo, poses = farm.captures[0] / "images" / farm.later.name, farm.captures[0] / "transforms.json"
    before = poses.read_text()
    shutil.copy(farm.later, photo)
    shutil.copy(farm.later.with_name("full.json"), poses)
    yield
    photo.unlink()
    poses.write_text(before)


def started(batch: Batch, captures: Sequence[Path]) -> dict[str, int]:
    return {path.name: len(stages(batch.root / path.name, "stage started")) for path in captures}


def test_fifty_corruptions(farm: Farm, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Found by `gsbake cache verify`, and by a batch, which computes the damaged stages again and no others."""
    shared = tmp_path / "store"
    shutil.copytree(farm.store, shared)
    rng = random.Random(11)
    entries = sorted((shared / "ac").rglob("*.json"))
    blobs = sorted(path for path in (shared / "cas").rglob("*") if path.is_file() and path.stat().st_size)
    victims = rng.sample(entries, DAMAGED // 2) + rng.sample(blobs, DAMAGED - DAMAGED // 2)
    owners = {path: json.loads(path.read_text()) for path in entries}
    broken = {path.relative_to(shared).as_posix() for path in victims}
    hit = {
        str(manifest["key"])
        for path, manifest in owners.items()
        if path in victims or any(f"cas/{f['digest'][:2]}/{f['digest']}" in broken for f in manifest["files"].values())
    }
    lost = {str(owners[path]["key"]) for path in victims if path in owners}
    plant_damage(victims, rng)
    shutil.copytree(shared, tmp_path / "copy")
    store = open_shared_store(str(tmp_path / "copy"))
    assert store is not None
    (tmp_path / "scratch").mkdir()
    found = set(store.verify(tmp_path / "scratch").damaged)
    tell(capsys, f"{DAMAGED} corruptions planted, {len(found & broken)} found by verify")
    assert broken <= found
    words = ["batch", *farm.captures, "--out", tmp_path / "out", "--profile", PROFILE, "--threads", 2, "--store", shared]
    with (tmp_path / "log").open("wb") as log:
        subprocess.run([sys.executable, "-m", "gsbake", *map(str, words)], stdout=log, stderr=log, check=True)
    computed = [
        event["key"] for path in farm.captures for event in events(tmp_path / "out" / path.name) if event["event"] == "stage started"
    ]
    tell(capsys, f"{len(hit)} of {len(entries)} stages damaged, {len(computed)} computed again")
    assert len(computed) == len(set(computed)) and lost <= set(computed) <= hit  # a file of two stages is whole again after the first
    for path in farm.captures:
        assert digests(tmp_path / "out" / path.name) == farm.plain[path.name]
    (tmp_path / "scratch2").mkdir()
    again = open_shared_store(str(shared))
    assert again is not None
    named = {f"cas/{digest[:2]}/{digest}" for entry in again.entries() for digest in entry.blobs}
    left = set(again.verify(tmp_path / "scratch2").damaged)  # files of a report that was made again, with other run times: of no entry
    assert not left & named and all(name.startswith("cas/") for name in left)
