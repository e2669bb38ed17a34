"""Photos of the toy pipeline, and servers on loopback that hold a shared store."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.pipeline.toy import engine
from tests.support.slow import slow
from tests.support.ssh_server import ServerUnavailable, SshServer

WORDS = "One two three"


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder with one file of three words."""
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.txt").write_text(WORDS)
    return folder


@pytest.fixture(scope="session")
def toy_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of one run of the toy pipeline on such photos."""
    root = tmp_path_factory.mktemp("toy")
    (root / "photos").mkdir()
    (root / "photos" / "a.txt").write_text(WORDS)
    engine(root / "out", root / "photos")[0].run()
    return root / "out"


@pytest.fixture
def finished(toy_run: Path, photos: Path, tmp_path: Path) -> Path:
    """A copy of it, as if `photos` had been run into it."""
    shutil.copytree(toy_run, tmp_path / "out", symlinks=True)
    return tmp_path / "out"


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The URL of a bucket on an object server on loopback."""
    pytest.importorskip("moto.server")
    pytest.importorskip("s3fs")
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    port = server._server.server_port
    keys = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**keys, "AWS_DEFAULT_REGION": "us-east-1"}.items():
            patch.setenv(name, value)
        import s3fs

        with suppress(FileExistsError):  # of another module: the server's buckets outlive it
            s3fs.S3FileSystem(skip_instance_cache=True).mkdir("farm")
        yield "s3://farm/cache"
    server.stop()


@pytest.fixture(scope="module")
def ssh(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SshServer]:
    """An SSH server on loopback that this process may use."""
    pytest.importorskip("paramiko")
    server = SshServer(tmp_path_factory.mktemp("ssh"))
    try:
        server.__enter__()
    except ServerUnavailable as error:
        pytest.skip(f"no SSH server can be started here: {error}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(server.home))
        yield server
    server.kill()


@pytest.fixture(params=["folder", slow("object server"), slow("SSH server")])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "folder":
        return str(tmp_path / "shared")
    if request.param == "SSH server":
        server: SshServer = request.getfixturevalue("ssh")
        return server.url(tmp_path / "shared")
    found: str = request.getfixturevalue("s3")
    return f"{found}/{tmp_path.name}"
