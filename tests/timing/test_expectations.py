"""Expectations from earlier runs beside the present one, scaled by photos and pixels."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from gsbake.pipeline.plan import Request
from gsbake.pipeline.store import Store
from gsbake.timing.estimate import History, formula
from gsbake.timing.expectations import MAX_RUNS, Expectations, runs_beside
from gsbake.timing.photos import PhotoSet, photos_of_request, photos_of_run
from gsbake.timing.usual_parts import PARTS, usual_parts

SETTINGS = {"bake.materials": "fit", "bake.size": 1024}


def a_run(out: Path, photos: int, pixels: int, **manifests: dict[str, Any]) -> Path:
    """A finished run: its ingest, and the manifests of further stages."""
    (out / "stages").mkdir(parents=True)
    (out / "project.json").write_text("{}")
    store = Store(out)
    for number, (stage, manifest) in enumerate({"ingest": {}, **manifests}.items()):
        folder = store.temporary(stage, f"{number:064x}")
        if stage == "ingest":
            entry = f'{{"source_width": {pixels}, "source_height": 1000}}'
            (folder / "photos.json").write_text(f'{{"photos": [{", ".join([entry] * photos)}]}}')
        body = {"stage": stage, "key": f"{number:064x}", "settings": SETTINGS, "peak_bytes": 10**9, "threads": 2, **manifest}
        store.publish(folder, store.folder(stage, f"{number:064x}"), body)
    return out


def expectations(out: Path) -> Expectations:
    profile: Any = SimpleNamespace()
    return Expectations(Request(out, {}, profile, threads=2), ("ingest", "bake", "stereo"))


def state(name: str, **settings: Any) -> Any:
    return SimpleNamespace(name=name, settings=SETTINGS | settings)


def test_the_same_settings_beside_it_tell_time_and_parts(tmp_path: Path) -> None:
    a_run(tmp_path / "old", 40, 1000, bake={"seconds": 200.0, "parts": {"atlas": 50.0, "trial fits": 100.0}})
    found = expectations(a_run(tmp_path / "new", 40, 1000)).of(state("bake"))
    assert found.seconds == pytest.approx(200) and found.same and found.measured == 1
    assert found.parts == {"atlas": 0.25, "trial fits": 0.5}


def test_more_photos_are_expected_to_take_longer(tmp_path: Path) -> None:
    a_run(tmp_path / "old", 40, 1000, stereo={"seconds": 90.0, "settings": {"stereo.max_size": 4000}})
    few = expectations(a_run(tmp_path / "few", 40, 1000)).of(state("stereo", **{"stereo.max_size": 4000}))
    more = expectations(a_run(tmp_path / "more", 80, 1000)).of(state("stereo", **{"stereo.max_size": 4000}))
    larger = expectations(a_run(tmp_path / "larger", 40, 4000)).of(state("stereo", **{"stereo.max_size": 4000}))
    assert few.seconds == pytest.approx(90) and not few.same  # it declares more settings
    assert more.seconds == pytest.approx(180, rel=0.02) and larger.seconds == pytest.approx(360, rel=0.03)


def test_other_settings_correct_the_formula_but_not_the_parts(tmp_path: Path) -> None:
    a_run(tmp_path / "old", 40, 1000, bake={"seconds": 50.0, "settings": SETTINGS | {"bake.materials": "none"}, "parts": {"atlas": 40.0}})
    new = a_run(tmp_path / "new", 40, 1000)
    found, photos = expectations(new).of(state("bake")), PhotoSet(40, 1.0)
    slower = 50 / formula("bake", photos, {"bake.materials": "none", "bake.size": 1024})[0]
    assert found.seconds == pytest.approx(slower * formula("bake", photos, SETTINGS)[0])
    assert found.measured == 1 and not found.same and found.parts == usual_parts("bake", SETTINGS)


def test_without_earlier_runs_formulas_and_usual_parts_stand_in(tmp_path: Path) -> None:
    found = expectations(tmp_path / "out").of(state("bake"))
    assert found.measured == 0 and found.parts == PARTS["bake fit"]
    assert usual_parts("toy", {}) == {} and usual_parts("bake", {"bake.materials": "surfels"}) == {}


def test_shares_of_parts_are_shares() -> None:
    for stage, parts in PARTS.items():
        assert 0.4 < sum(parts.values()) <= 1 and min(parts.values()) > 0, stage


def test_the_latest_runs_are_read(tmp_path: Path) -> None:
    for number in range(MAX_RUNS + 4):
        folder = tmp_path / f"run{number}"
        folder.mkdir()
        (folder / "project.json").write_text("{}")
        os.utime(folder / "project.json", (number, number))
    (tmp_path / "no run").mkdir()
    assert runs_beside(tmp_path / "new") == [tmp_path / f"run{number}" for number in range(MAX_RUNS + 3, 3, -1)]


def test_a_folder_that_cannot_be_read_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = (a_run(tmp_path / name, 40, 1000, bake={"seconds": 200.0}) for name in ("good", "bad"))
    read = Store.manifests

    def manifests(self: Store, stage: str) -> Any:
        if self.out == bad:
            raise PermissionError(13, "no")
        return read(self, stage)

    monkeypatch.setattr(Store, "manifests", manifests)
    assert len(History.of_runs([bad, good], ["bake"]).runs["bake"]) == 1


def test_photos_before_and_after_they_were_read(tmp_path: Path) -> None:
    assert photos_of_run(tmp_path / "none") is None
    assert photos_of_run(a_run(tmp_path / "run", 7, 3000)) == PhotoSet(7, 3.0)
    (tmp_path / "images").mkdir()
    Image.new("RGB", (400, 300)).save(tmp_path / "images" / "b.png")
    (tmp_path / "images" / "a.png").write_bytes(b"no photo")
    profile: Any = SimpleNamespace()
    request = Request(tmp_path, {"photos": tmp_path / "images"}, profile, source_names={"photos": ["a.png", "b.png"]})
    assert photos_of_request(request) == PhotoSet(2, 0.12)
