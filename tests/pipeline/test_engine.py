"""The engine on toy stages: cache hits and misses, manifests, and errors."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from gsbake.errors import BadInputError, InterruptedRun, UsageError
from gsbake.pipeline.files import disk_error
from gsbake.pipeline.registry import Registry
from gsbake.pipeline.stage import Stage
from gsbake.pipeline.supervise import StageFailed
from tests.pipeline.toy import LaterSum, LaterToy, Read, Sum, Toy, engine, only


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.txt").write_text("one two")
    (folder / "b.txt").write_text("three")
    return folder


def total(steps: int, words: int, seed: int = 0) -> int:
    value = seed
    for step in range(steps):
        value = (value * 31 + words + step) % 1_000_003
    return value


def test_second_run_is_cached(tmp_path: Path, photos: Path) -> None:
    first, seen = engine(tmp_path / "out", photos)
    states = first.run()
    assert seen.ran == ["read", "sum", "tell"] and seen.cached == []
    assert (states[2].artifact.folder / "tell.txt").read_text() == f"total {total(10, 3)}"  # type: ignore[union-attr]
    assert seen.reports[-1] == (10, 10, {"psnr": 10.0}) and seen.parts == [("sum", "loop")]
    second, again = engine(tmp_path / "out", photos)
    second.run()
    assert again.ran == [] and again.cached == ["read", "sum", "tell"]


def test_only_stages_that_compute_are_announced_beforehand(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    changed, _ = engine(tmp_path / "out", photos, Toy(sum=Sum(steps=11)))
    announced: list[str] = []
    changed.before_stage = lambda stage, check: announced.append(stage.name)
    changed.run()
    assert announced == ["sum", "tell"]

    def stop(stage: Stage, check: Callable[[], None]) -> None:
        raise InterruptedRun("Stopped on request.")

    stopped, seen = engine(tmp_path / "out", photos, Toy(sum=Sum(steps=12)))
    stopped.before_stage = stop
    with pytest.raises(InterruptedRun):
        stopped.run()
    assert seen.ran == [] and [state.status for state in stopped.plan()] == ["cached", "run", "waits"]


def test_manifest_content(tmp_path: Path, photos: Path) -> None:
    states = engine(tmp_path / "out", photos)[0].run()
    manifest = json.loads((states[1].artifact.folder / "manifest.json").read_text())  # type: ignore[union-attr]
    assert manifest["settings"] == {"sum.step_seconds": 0.0, "sum.steps": 10}
    assert manifest["inputs"]["read"]["digest"] == states[0].artifact.digest  # type: ignore[union-attr]
    assert manifest["key"].startswith(states[1].artifact.folder.name)  # type: ignore[union-attr]
    assert manifest["results"] == {"total": total(10, 3)}
    assert manifest["parts"].keys() == {"loop"} and manifest["seconds"] > 0
    assert 5e6 < manifest["peak_bytes"] < 2e9
    assert manifest["seed"] == 0 and manifest["backend"] is None and not manifest["resumed"]
    assert manifest["host"]["cores"] >= 1 and manifest["versions"]["python"].startswith("3.")
    assert manifest["files"]["total.txt"]["bytes"] == len(str(total(10, 3)))
    read = json.loads((states[0].artifact.folder / "manifest.json").read_text())  # type: ignore[union-attr]
    assert read["decisions"] == [{"what": "case", "choice": "lower", "evidence": "it is a toy"}]
    assert read["inputs"]["photos"]["files"].keys() == {"a.txt", "b.txt"}
    events = [json.loads(line) for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines()]
    assert [e["event"] for e in events if e.get("stage") == "sum"] == ["stage started", "decision", "stage finished"]
    assert manifest["decisions"] == [{"what": "rest", "choice": "skipped", "evidence": "not needed", "saved_s": 12.3}]
    assert events[-1]["event"] == "run ended" and events[-1]["exit_code"] == 0


def test_changed_setting_reruns_only_the_stages_that_declare_it(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    changed, seen = engine(tmp_path / "out", photos, Toy(sum=Sum(steps=11)))
    assert [(s.name, s.status) for s in changed.plan()] == [("read", "cached"), ("sum", "run"), ("tell", "waits")]
    assert changed.plan()[1].reasons == ("sum.steps: 10 → 11",)
    changed.run()
    assert seen.cached == ["read"] and seen.ran == ["sum", "tell"]
    back, seen = engine(tmp_path / "out", photos, Toy(sum=Sum(ignored="y")))
    back.run()
    assert seen.ran == []  # the old value again, and an undeclared field


def test_early_cut_off(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    (photos / "a.txt").write_text("ONE TWO")  # other bytes, same words
    changed, seen = engine(tmp_path / "out", photos)
    assert changed.plan()[0].reasons == ("photos: a.txt changed",)
    assert changed.plan()[1].status == "waits"
    changed.run()
    assert seen.ran == ["read"] and seen.cached == ["sum", "tell"]


def test_reasons_name_changed_files(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    (photos / "b.txt").unlink()
    (photos / "c.txt").write_text("four")
    assert engine(tmp_path / "out", photos)[0].plan()[0].reasons == ("photos: c.txt added, b.txt removed",)


def test_new_field_at_its_default_keeps_the_keys(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    registry = Registry(
        {"read": "tests.pipeline.toy:READ", "sum": "tests.pipeline.test_engine:WIDER_SUM", "tell": "tests.pipeline.toy:TELL"}
    )
    later, seen = engine(tmp_path / "out", photos, LaterToy(), registry)
    later.run()
    assert seen.ran == []
    other, seen = engine(tmp_path / "out", photos, LaterToy(sum=LaterSum(extra=8)), registry)
    assert other.plan()[1].reasons == ("sum.extra: 7 → 8",)


def test_changed_default_is_detected(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    assert engine(tmp_path / "out", photos, OtherDefault())[0].plan()[1].status == "run"


def test_damaged_artifacts_are_invalid(tmp_path: Path, photos: Path) -> None:
    states = engine(tmp_path / "out", photos)[0].run()
    folder = states[1].artifact.folder  # type: ignore[union-attr]
    (folder / "total.txt").write_text("123")
    again, seen = engine(tmp_path / "out", photos)
    assert "total.txt" in again.plan()[1].reasons[0] and "was modified" in again.plan()[1].reasons[0]
    again.run()
    assert seen.ran == ["sum"] and (folder / "total.txt").read_text() == str(total(10, 3))
    (folder / "manifest.json").unlink()
    again, seen = engine(tmp_path / "out", photos)
    again.run()
    assert seen.ran == ["sum"]
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace('"total": ', '"total": 1'))
    again, seen = engine(tmp_path / "out", photos)
    again.run()
    assert seen.ran == ["sum"] and (folder / "manifest.json").read_text() != text.replace('"total": ', '"total": 1')
    (folder / "total.txt").unlink()
    assert "is missing" in engine(tmp_path / "out", photos)[0].plan()[1].reasons[0]


def test_seed_and_last_stage(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    seeded, seen = engine(tmp_path / "out", photos, seed=4)
    assert seeded.plan()[1].reasons == ("seed: 0 → 4",)
    states = seeded.run("sum")
    assert seen.cached == ["read"] and seen.ran == ["sum"] and len(states) == 2
    assert states[1].artifact.manifest["results"] == {"total": total(10, 3, seed=4)}  # type: ignore[union-attr]
    with pytest.raises(UsageError, match="no stage 'sun'; the stages are read, sum, tell"):
        seeded.run("sun")


def test_copied_photos_have_the_same_keys(tmp_path: Path, photos: Path) -> None:
    engine(tmp_path / "out", photos)[0].run()
    shutil.copytree(photos, tmp_path / "elsewhere")
    moved, seen = engine(tmp_path / "out", tmp_path / "elsewhere")
    moved.run()
    assert seen.ran == []


def test_undeclared_setting_fails_the_stage(tmp_path: Path, photos: Path) -> None:
    made, _ = engine(tmp_path / "out", photos, registry=only("undeclared"))
    with pytest.raises(StageFailed, match=r"UndeclaredSetting: stage 'undeclared' reads the setting 'sum.ignored'"):
        made.run()
    saved = list((tmp_path / "out" / "errors").iterdir())
    assert len(saved) == 1 and "Traceback" in saved[0].read_text()
    assert not list((tmp_path / "out" / "stages" / "undeclared").glob("*.tmp-*"))


@pytest.mark.parametrize(
    ("kind", "error", "text", "code"),
    [
        ("bad", BadInputError, "The toy is broken; buy another.", 42),
        ("memory", InterruptedRun, "Out of memory", 75),
        ("full", InterruptedRun, "is full; free some space", 75),
        ("other", StageFailed, "ValueError: unexpected value", 1),
    ],
)
def test_errors_of_a_stage_are_raised_again(tmp_path: Path, kind: str, error: type[BadInputError], text: str, code: int) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "kind.txt").write_text(kind)
    with pytest.raises(error, match=text) as caught:
        engine(tmp_path / "out", folder, registry=only("raise"))[0].run()
    assert caught.value.exit_code == code
    assert "\n" not in str(caught.value)


def test_native_crash_raises_stage_failed(tmp_path: Path, photos: Path) -> None:
    with pytest.raises(StageFailed, match="ended with SIGABRT"):
        engine(tmp_path / "out", photos, registry=only("crash"))[0].run()
    saved = list((tmp_path / "out" / "errors").iterdir())
    assert "about to crash" in saved[0].read_text()


def test_a_worker_ended_from_outside_can_be_run_again(tmp_path: Path, photos: Path) -> None:
    """A signal that reaches a worker before it handles signals is no failure of the stage."""
    with pytest.raises(InterruptedRun, match="ended from outside by SIGTERM") as caught:
        engine(tmp_path / "out", photos, registry=only("terminated"))[0].run()
    assert caught.value.exit_code == 75


def test_unwritable_output(tmp_path: Path, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="a file of that name exists"):
        engine(tmp_path / "file", photos)[0].run()
    with pytest.raises(BadInputError, match="cannot be created"):
        engine(Path("/proc/gsbake-out"), photos)[0].run()

    def refuse(path: Path, *_: object) -> None:
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(BadInputError, match="cannot be written .Read-only file system.; choose another with --out"):
        engine(tmp_path / "out", photos)[0].run()


def test_disk_error_ignores_other_errors(tmp_path: Path) -> None:
    assert disk_error(ValueError("x"), tmp_path) is None
    assert disk_error(PermissionError(13, "Permission denied", "/elsewhere/photo.jpg"), tmp_path) is None
    assert disk_error(PermissionError(13, "Permission denied", str(tmp_path / "a" / "b")), tmp_path) is not None


# Stages and profiles of these tests only.
from tests.pipeline import toy  # noqa: E402

WIDER_SUM = Stage("sum", 1, "Sum slowly", toy._sum, needs=("read",), settings=("sum.steps", "sum.step_seconds", "sum.extra"), seeded=True)


class OtherSum(Sum):
    steps: int = 12


class OtherDefault(Toy):
    read: Read = Read()
    sum: OtherSum = OtherSum()
