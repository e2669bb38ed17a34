"""A store's credentials: the connection alone has them. No message, no file, no command of a job."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import gsbake.api
from gsbake.batch import workflow
from gsbake.batch.captures import BatchOptions, plan_captures
from gsbake.batch.coordinator import run_batch
from gsbake.batch.emit import FORMATS
from gsbake.batch.job import run_job
from gsbake.batch.jobs import make_jobs
from gsbake.batch.records import load_batch, save_batch
from gsbake.batch.workflow import Execution
from gsbake.pipeline.shared_store import SharedStore, StoreUnreachableError
from gsbake.pipeline.store_url import VARIABLE, has_credentials, hide_credentials, public_url
from gsbake.timing.estimate import History
from tests.cli import toy_bake
from tests.cli.conftest import End, Run

Make = Callable[..., Path]
SECRET = "s3cr3t/p%40ss"
REFUSING = f"sftp://anna:{SECRET}@127.0.0.1:1/farm"
MEMORY = f"memory://anna:{SECRET}@farm/cache"


def check_hidden(folder: Path, *ends: End) -> None:
    """The secret is nowhere, decoded or not."""
    texts = [end.out + end.err for end in ends]
    texts += [path.read_bytes().decode(errors="replace") for path in folder.rglob("*") if path.is_file()]
    assert not [text for text in texts if "s3cr3t" in text or "p%40ss" in text or "p@ss" in text]


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("sftp://anna@host/farm", "sftp://anna@host/farm"),
        ("sftp://anna:word@host:22/farm", "sftp://host:22/farm"),
        ("sftp://anna:wo/r@d?x@host/farm", "sftp://host/farm"),
        ("sftp://host:22/a@b", "sftp://host:22/a@b"),
        ("s3://KEY:wo/rd+x@bucket/path", "s3://bucket/path"),
        ("s3://KEY:12/34@bucket/path", "s3://bucket/path"),
        ("s3://bucket/path?token=word", "s3://bucket/path"),
        ("https://token@host/x", "https://host/x"),
        ("s3://bucket/a@b", "s3://bucket/a@b"),
        ("/store/a:b@c?d", "/store/a:b@c?d"),
        ("file:///store/a:b@c", "file:///store/a:b@c"),
    ],
)
def test_an_address_without_credentials(url: str, shown: str) -> None:
    assert public_url(url) == shown and has_credentials(url) == (url != shown)
    assert hide_credentials(f"no answer of {url}.", url) == f"no answer of {shown}."


def test_credentials_in_words_of_libraries() -> None:
    assert hide_credentials("user anna, password s3cr3t/p@ss, anna:s3cr3t/p%40ss@", REFUSING) == "user ***, password ***, ***"
    assert hide_credentials("bad token word", "s3://b/p?token=word&x=1") == "bad token ***"


def test_a_store_that_refuses(run: Run, make_capture: Make, tmp_path: Path) -> None:
    pytest.importorskip("paramiko")
    capture = make_capture("one")
    ends = [run("cache", "ls", "--store", REFUSING), run("run", capture, "--out", "out", "--store", REFUSING)]
    ends += [run("run", capture, "--out", "out", "--store", REFUSING.replace("sftp", "ftp"))]
    assert [end.code for end in ends] == [75, 75, 2] and all("://127.0.0.1:1/farm'" in end.err for end in ends)
    check_hidden(tmp_path / "out", *ends)


def test_words_of_a_store_that_does_not_answer() -> None:
    """A library's exception that quotes the password, also where the text is cut off."""

    class Failing:
        def cat_file(self, path: str) -> bytes:
            raise OSError("x" * 170 + f" login to {REFUSING} with s3cr3t/p@ss failed")

    store = SharedStore(REFUSING, Failing(), "/farm", "sftp", patience=0.0)
    with pytest.raises(StoreUnreachableError) as error:
        store.quota()
    assert "s3cr" not in str(error.value) and store.url == "sftp://127.0.0.1:1/farm"


def test_runs(run: Run, make_capture: Make, tmp_path: Path) -> None:
    capture = make_capture("one")
    ends = [run("run", capture, "--out", f"out/{name}", "--store", MEMORY, "--json") for name in ("first", "second")]
    assert ends[1].json["stages"][0]["reasons"] == ["from the shared store"]
    assert "memory://farm/cache" in (tmp_path / "out" / "second" / "events.jsonl").read_text()
    check_hidden(tmp_path / "out", *ends, *(run("cache", *words, "--store", MEMORY) for words in (["ls"], ["verify"], ["gc"])))


@pytest.mark.parametrize("form", FORMATS)
def test_jobs_for_schedulers_take_it_from_the_environment(run: Run, make_capture: Make, form: str, tmp_path: Path) -> None:
    end = run("plan", make_capture("one"), "--store", MEMORY, "--emit", form)
    assert end.code == 0 and "--store" not in end.out and f"set {VARIABLE}" in end.err and end.err.count("\n") == 1
    check_hidden(tmp_path / "out", end)
    plain = run("plan", make_capture("two"), "--store", "sftp://anna@host/farm", "--emit", form)
    assert "sftp://anna@host/farm" in plain.out and not plain.err


def test_jobs_of_a_batch(make_capture: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their document has no address; the environment, which they inherit, has it, and they use it."""
    import fsspec

    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.REGISTRY)
    url = MEMORY.replace("cache", "batch")
    options = BatchOptions(tmp_path / "out", "smoke", threads=1, store=url)
    captures = [make_capture("one")]
    jobs = make_jobs(plan_captures(captures, options), options, History(), 1)
    save_batch(captures, options)
    work = tmp_path / "out" / ".batch" / "snakemake"
    work.mkdir()
    arguments = workflow._prepare(jobs, options, Execution(1), work, "unused")
    check_hidden(tmp_path / "out", End(0, json.dumps(arguments), ""))
    assert load_batch(tmp_path / "out")[1].store is None
    monkeypatch.setenv(VARIABLE, workflow.job_environment(options)[VARIABLE])
    assert run_job(json.loads((work / workflow.DOCUMENT).read_text()), jobs[0].id).exit_code == 0
    assert len([path for path in fsspec.filesystem("memory").find(url.removeprefix("memory://")) if "/batch/ac/" in path]) == 4
    check_hidden(tmp_path / "out")


@pytest.mark.slow
def test_a_batch(make_capture: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("snakemake")
    monkeypatch.setattr(gsbake.api, "REGISTRY", toy_bake.REGISTRY)
    (outcome,) = run_batch([make_capture("one")], BatchOptions(tmp_path / "out", "smoke", threads=1, store=MEMORY))
    assert outcome.state == "done"
    check_hidden(tmp_path / "out")
