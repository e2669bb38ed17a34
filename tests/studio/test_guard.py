"""Who is answered: the token, the cookie, the host, the origin; and that no path leads out of a capture."""

from __future__ import annotations

import http.client
import os
import random
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from gsbake.studio.server import Studio
from gsbake.studio.workspace import Folder, OneRun
from tests.studio.conftest import Browser, write_capture


def test_only_with_the_token_then_the_cookie(browser: Browser) -> None:
    """Every address is 404 without the cookie, which the token alone gives."""
    stranger, token = browser.stranger(), browser.studio.token
    wrong = (f"/?token={token[:-1]}", f"/web/app.js?token={token}", f"/?x=1&token={token}")
    for path in ("/", "/api/captures", "/web/app.js", "/?token=", *wrong):
        found = stranger.ask("GET", path)
        assert (found.code, found.content) == (404, b""), path
    for cookie in (f"{browser.cookie}x", f"other={token}; ===;", browser.cookie.partition("=")[0], "\xff"):
        assert stranger.ask("GET", "/", Cookie=cookie).code == 404
    answer = stranger.ask("GET", f"/?token={token}")
    cookie = answer.headers["set-cookie"]
    assert answer.code == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
    stranger.cookie = cookie.partition(";")[0]
    assert stranger.get("/api/captures")["captures"] == [] and "set-cookie" not in stranger.ask("GET", "/").headers
    stranger.close()


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1:{port}.evil", "", None])
def test_other_hosts_are_refused(host: str | None, browser: Browser) -> None:
    assert browser.ask("GET", "/api/captures", Host=host and host.format(port=browser.studio.port)).code in (400, 404)


def test_changes_need_the_pages_origin(browser: Browser) -> None:
    write_capture(browser.folder / "a")
    changes = [("POST", "/api/captures"), ("POST", "/api/captures/a/settings"), ("DELETE", "/api/captures/a/run"),
               ("PUT", "/api/captures/a/upload/x.jpg?offset=0&size=3"), ("PUT", "/api/captures/a/masks/p0.jpg")]  # fmt: skip
    for method, path in changes:
        for origin in (None, "null", "http://evil.example", browser.origin.replace("http", "https"), "http://127.0.0.1:1"):
            assert browser.ask(method, path, b"{}", Origin=origin).code == 403, (method, path, origin)
    assert not (browser.folder / "a/masks").exists() and not (browser.folder / "out").exists()


def test_every_answer_has_the_headers_that_keep_it_apart(browser: Browser) -> None:
    for path in ("/", "/web/app.js", "/api/captures", "/nothing"):
        headers = browser.ask("GET", path).headers
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"
        policy = headers["content-security-policy"].replace("wasm-unsafe-eval", "")
        assert "default-src 'none'" in policy and "unsafe" not in policy


def test_paths_do_not_lead_out_of_a_capture(browser: Browser) -> None:
    (browser.folder.parent / "secret.jpg").write_bytes(b"secret")
    (browser.folder.parent / "other").mkdir()
    write_capture(browser.folder.parent / "other" / "outside")
    write_capture(browser.folder / "a")
    (browser.folder / "a/images/link.jpg").symlink_to(browser.folder.parent / "secret.jpg")
    (browser.folder / "linked").symlink_to(browser.folder.parent / "other/outside")
    (browser.folder / "half").mkdir()
    (browser.folder / "half/images").symlink_to(browser.folder.parent / "other/outside/images")
    (browser.folder / "out/a").mkdir(parents=True)
    (browser.folder / "out/a/asset.glb").symlink_to(browser.folder.parent / "secret.jpg")
    (browser.folder / "out/a/notes.txt").write_text("mine")
    assert [row["name"] for row in browser.get("/api/captures")["captures"]] == ["a"]
    assert [row["name"] for row in browser.get("/api/captures/a/photos")["photos"]] == ["p0.jpg", "p1.jpg", "p2.jpg", "p3.jpg"]
    names = ["../secret.jpg", "..%2Fsecret.jpg", "..%2F..%2Fsecret.jpg", "%2Fetc%2Fpasswd", "link.jpg", "images%2Fp0.jpg", "p0.jpg%00", "."]
    for name in names:
        for base in ("photos", "masks", "files", "asset/maps", "asset/views", "asset/pictures/lights", "asset/pictures/.."):
            assert browser.ask("GET", f"/api/captures/a/{base}/{name}").code in (404, 405, 422), (base, name)
    for name in ("asset.glb", "notes.txt", "project.json", "live.json"):
        assert browser.ask("GET", f"/api/captures/a/files/{name}").code == 404, name
    for name in ("linked", "half", "..", "%2e%2e", "..%2Fother%2Foutside", "out", ".", ".gsbake-studio", "a%2Fimages"):
        assert browser.ask("GET", f"/api/captures/{name}/photos").code == 404, name


def test_a_name_never_becomes_markup(browser: Browser) -> None:
    """It is a string of a JSON answer, which no browser shows as a page; test_web.py has the scripts."""
    write_capture(browser.folder / "a")
    name = "<img src=x onerror=alert(1)>.jpg" if os.name == "posix" else "&lt;.jpg"
    (browser.folder / "a/images/p0.jpg").rename(browser.folder / "a/images" / name)
    answer = browser.ask("GET", "/api/captures/a/photos")
    assert answer.headers["content-type"] == "application/json" and name in [row["name"] for row in answer.json["photos"]]


def test_hostile_requests_get_a_refusal(browser: Browser) -> None:
    """Random methods, paths and bodies: never an internal error, and nothing is written."""
    write_capture(browser.folder / "a")
    before = sorted(browser.folder.rglob("*"))
    rng = random.Random(0)
    words = ("api", "captures", "a", "photos", "masks", "settings", "scene", "epipolar", "plan", "asset", "files", "upload")
    parts = (*words, "..", "%00", "%E2%80%AE", "x" * 300)
    bodies = [
        b"", b"{}", b"[]", b"{", b"\xff", b'{"set": 3}', b'{"set": {"a.b": 1}}', b'{"unset": {}}', b'{"profile": []}', b"[" * 3000,
        b'{"name": "../x"}', b'{"name": 3}', b'{"set": {"mesh.faces": "many"}}', b'{"until": "x; rm"}',
        b'{"x": 1e999, "y": 0, "photo": "p0.jpg", "other": "p1.jpg"}',
    ]  # fmt: skip
    paths = ["/" + "/".join(rng.choice(parts) for _ in range(rng.randint(1, 6))) for _ in range(120)]
    ends = ("settings", "plan", "scene/epipolar", "masks/p0.jpg", "upload/p9.jpg", "upload/x.exe?offset=0&size=2")
    paths += [f"/api/captures/a/{end}" for end in ends]
    for path in paths:
        for method in ("GET", "POST", "PUT", "DELETE"):
            found = browser.ask(method, path, rng.choice(bodies))
            assert found.code < 500, (method, path, found.content)
    assert sorted(p for p in browser.folder.rglob("*") if ".gsbake-studio" not in p.parts) == before


def test_the_server_listens_on_loopback_and_is_gone_afterwards(extra: None, tmp_path: Path) -> None:
    with Studio(Folder(tmp_path)) as studio:
        assert studio.address.startswith("http://127.0.0.1:") and len(studio.token) >= 22
        answer = urllib.request.urlopen(studio.address, timeout=10)
        assert answer.status == 200 and b"app.js" in answer.read() and "uvicorn" not in str(answer.headers).lower()
        connection = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=10)
        connection.request("GET", "/api/captures")
        assert connection.getresponse().status == 404
        connection.close()
        long, negative = b"GET " + b"/" * 200_000 + b" HTTP/1.1\r\n\r\n", b"POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n"
        for hostile in (b"\x00" * 50, b"GET / HTTP/9.9\r\n\r\n", long, negative):
            raw = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=10)
            raw.connect()
            assert raw.sock is not None
            try:
                raw.sock.sendall(hostile)
                answer_line = raw.sock.recv(100)
                assert not answer_line.startswith(b"HTTP/1.1 200") and not answer_line.startswith(b"HTTP/1.1 5")
            except OSError:
                pass  # it closed the connection
            raw.close()
        assert urllib.request.urlopen(studio.address, timeout=10).status == 200
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(studio.address, timeout=10)


def test_one_run_shows_itself_alone(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "a")
    write_capture(tmp_path / "b")
    one = OneRun.of(capture / "images", tmp_path / "elsewhere")
    assert [found.name for found in one.captures()] == ["elsewhere"]
    assert list(one.capture("elsewhere").photos()) == [f"p{k}.jpg" for k in range(4)]
