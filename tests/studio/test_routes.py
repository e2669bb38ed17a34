"""What the page asks of the server, capture by capture; the stages that take time are in the browser's test."""

from __future__ import annotations

import http.client
import json
import os
import time
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from gsbake.geometry.cameras import CameraSet, Similarity
from gsbake.geometry.ply import write_cloud
from gsbake.pipeline.store import _seal
from gsbake.studio.grab_cut import grab_cut
from tests.studio.conftest import Browser, photo, write_capture
from tests.support.cameras import look_at

TO_WORLD = Similarity(2.0, np.eye(3), np.array([0.5, 0, 1]))


def encoded(image: np.ndarray, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def decoded(content: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image)


def write_output(out: Path, stage: str, results: dict[str, object]) -> Path:
    folder = out / "stages" / stage / "0123456789abcdef"
    folder.mkdir(parents=True)
    manifest = {"stage": stage, "key": "0" * 64, "files": {}, "results": results, "finished": "2026-01-01", "settings": {}}
    (folder / "manifest.json").write_text(json.dumps(manifest | {"seal": _seal(manifest)}))
    return folder


@pytest.fixture
def posed(browser: Browser) -> Browser:
    """A capture whose photos have cameras."""
    write_capture(browser.folder / "a")
    out = browser.folder / "out/a"
    ingest = write_output(out, "ingest", {"photos": 4})
    rows = [{"name": f"p{k}", "source": f"p{k}.jpg", "source_width": 64, "source_height": 48, "mask": None} for k in range(4)]
    (ingest / "photos.json").write_text(json.dumps({"photos": rows, "skipped": []}))
    poses = write_output(out, "poses", {"doubtful_masks": ["p2"], "not_registered": ["p3"]})
    cameras = [look_at((3 * np.cos(a), 3 * np.sin(a), 0.5), size=64, focal=80.0, name=f"p{k}") for k, a in enumerate((0.0, 0.4, 1.2))]
    CameraSet(tuple(cameras), TO_WORLD, "solved").save(poses / "cameras.json")
    CameraSet(tuple(camera.moved(TO_WORLD) for camera in cameras), poses="solved").save(poses / "photo_cameras.json")
    write_cloud(poses / "points.ply", np.array([(0.0, 0, 0), (0.5, 0, 0.25)]), np.array([(255, 0, 0), (0, 9, 0)], np.uint8))
    return browser


def test_a_capture_is_made_and_its_files_arrive_in_pieces(browser: Browser) -> None:
    assert browser.send("POST", "/api/captures", {"name": "mug"})["source"] == "mug"
    content = encoded(photo(1), ".jpg")
    path = "/api/captures/mug/upload/one.jpg"
    first = browser.send("PUT", f"{path}?offset=0&size={len(content)}", content[:100])
    assert first == {"bytes": 100, "complete": 0} and browser.get(path) == {"bytes": 100, "complete": 0}
    assert browser.get("/api/captures/mug/photos")["photos"] == []  # not before it is complete
    assert "100 bytes" in browser.send("PUT", f"{path}?offset=50&size={len(content)}", content[50:], 400)["error"]
    assert browser.send("PUT", f"{path}?offset=100&size={len(content)}", content[100:])["complete"] == 1
    assert (browser.folder / "mug/images/one.jpg").read_bytes() == content
    assert [row["name"] for row in browser.get("/api/captures/mug/photos")["photos"]] == ["one.jpg"]
    assert browser.send("PUT", "/api/captures/mug/upload/film.mp4?offset=0&size=3", b"abc")["complete"] == 1
    assert (browser.folder / "mug/film.mp4").exists()


@pytest.mark.parametrize("name", ["../x", "out", "MUG", "a/b", ".hidden", "con", "", "x" * 300, "a\u202eb", "masks"])
def test_a_capture_needs_a_name_of_its_own(name: str, browser: Browser) -> None:
    write_capture(browser.folder / "mug")
    browser.send("POST", "/api/captures", {"name": name}, 400)
    assert sorted(path.name for path in browser.folder.iterdir()) == ["mug"]


@pytest.mark.parametrize(
    "name, query, sentence",
    [
        ("x.exe", "offset=0&size=3", "neither a photo nor a video"),
        ("..%2Fx.jpg", "offset=0&size=3", ""),
        (".x.jpg", "offset=0&size=3", "cannot be the name"),
        ("con.jpg", "offset=0&size=3", "cannot be the name"),
        ("P0.jpg", "offset=0&size=3", "up to capitals"),
        ("p0.jpg", "offset=0&size=3", "already a file"),
        ("x.jpg", "offset=0&size=2000000000", "more than 1 GB"),
        ("x.jpg", "offset=0&size=0", "is empty"),
        ("x.jpg", "offset=-1&size=3", "is empty or"),
        ("x.jpg", "offset=0&size=2", "more than the 2 bytes"),
        ("x.jpg", "offset=a&size=b", "lacks"),
    ],
)
def test_uploads_are_limited(name: str, query: str, sentence: str, browser: Browser) -> None:
    write_capture(browser.folder / "mug")
    before = sorted(path.name for path in browser.folder.rglob("*.jpg"))
    found = browser.ask("PUT", f"/api/captures/mug/upload/{name}?{query}", b"abc")
    assert found.code in (400, 404) and sentence in found.content.decode()
    assert sorted(path.name for path in browser.folder.rglob("*.jpg")) == before and not list(browser.folder.rglob("*.exe"))


@pytest.mark.skipif(os.name != "posix", reason="links and pipes of POSIX")
def test_an_upload_writes_to_no_link_and_waits_for_no_pipe(browser: Browser, tmp_path: Path) -> None:
    images = write_capture(browser.folder / "a") / "images"
    (tmp_path / "mine.txt").write_bytes(b"mine")
    (images / ".link.jpg.part").symlink_to(tmp_path / "mine.txt")
    os.mkfifo(images / ".pipe.jpg.part")
    for name, offset in (("link", 4), ("pipe", 0)):
        error = browser.send("PUT", f"/api/captures/a/upload/{name}.jpg?offset={offset}&size={offset + 3}", b"abc", 400)["error"]
        assert "in the way" in error
    assert (tmp_path / "mine.txt").read_bytes() == b"mine"


def test_two_pages_that_upload_one_file_do_not_mix_it(browser: Browser) -> None:
    write_capture(browser.folder / "a")
    path = "/api/captures/a/upload/two.jpg?offset=0&size=6"
    first = http.client.HTTPConnection("127.0.0.1", browser.studio.port, timeout=30)
    first.putrequest("PUT", path)
    for name, value in (("Cookie", browser.cookie), ("Origin", browser.origin), ("Content-Length", "6")):
        first.putheader(name, value)
    first.endheaders()  # its body comes later
    part = browser.folder / "a/images/.two.jpg.part"
    for _ in range(500):
        if part.exists():
            break
        time.sleep(0.01)
    assert "another page" in browser.send("PUT", path, b"second", 400)["error"]
    first.send(b"first.")
    assert json.loads(first.getresponse().read()) == {"bytes": 6, "complete": 1}
    first.close()
    assert (browser.folder / "a/images/two.jpg").read_bytes() == b"first."


def test_photos_are_shown_small_and_made_once(browser: Browser) -> None:
    write_capture(browser.folder / "a", 2)
    cv2.imwrite(str(browser.folder / "a/images/large.jpg"), photo(3, (1200, 900)))
    (browser.folder / "a/images/broken.jpg").write_bytes(b"no photo")
    answer = browser.ask("GET", "/api/captures/a/photos/large.jpg")
    assert decoded(answer.content).shape == (270, 360, 3) and "immutable" in answer.headers["cache-control"]
    (made,) = (browser.folder / ".gsbake-studio/a/images").glob("*.jpg")
    stamp = made.stat().st_mtime_ns
    assert browser.ask("GET", "/api/captures/a/photos/large.jpg").content == answer.content and made.stat().st_mtime_ns == stamp
    assert decoded(browser.get("/api/captures/a/photos/large.jpg?size=large")).shape == (900, 1200, 3)
    assert "cannot be read" in browser.get("/api/captures/a/photos/broken.jpg", 422)["error"]
    assert "cannot be read" in browser.get("/api/captures/a/thumbnail", 422)["error"]  # of the first photo, the broken one


def test_settings_are_those_of_the_command_line(browser: Browser) -> None:
    write_capture(browser.folder / "a")
    path = "/api/captures/a/settings"
    assert browser.get(path) == {"profile": "relight", "settings": {}, "stored": False}
    browser.send("POST", path, {"profile": "smoke", "set": {"ingest.leave_out": ["p1.jpg"], "mesh.faces": 700}})
    project = json.loads((browser.folder / "out/a/project.json").read_text())
    assert project["profile"] == "smoke" and project["overrides"] == ['ingest.leave_out=["p1.jpg"]', "mesh.faces=700"]
    assert project["photos"] == str((browser.folder / "a/images").resolve())
    found = browser.send("POST", path, {"unset": ["mesh.faces"]})
    assert found == {"profile": "smoke", "settings": {"ingest.leave_out": ["p1.jpg"]}, "stored": True} == browser.get(path)
    assert [row["left_out"] for row in browser.get("/api/captures/a/photos")["photos"]] == [False, True, False, False]
    for body, sentence in (
        ({"set": {"mesh.faces": 3}}, "from 100"),
        ({"set": {"mesh.triangles": 3}}, "no setting"),
        ({"profile": "../x"}, "no profile"),
        ({"set": []}, "'set'"),
    ):
        found = browser.ask("POST", path, json.dumps(body).encode())
        assert found.code in (400, 422) and sentence in found.json["error"]
    assert browser.get(path)["settings"] == {"ingest.leave_out": ["p1.jpg"]}


def test_the_form_is_made_from_the_settings_own_descriptions(browser: Browser) -> None:
    found = browser.get("/api/settings?profile=smoke")
    fields = {field["key"]: field for field in found["settings"]}
    assert {"relight", "smoke"} <= set(found["profiles"]) and "gsdf" not in found["profiles"]
    assert sum(field["first"] is not None for field in found["settings"]) == 12
    assert fields["bake.size"]["kind"] == "choice" and {"auto", 1024} <= set(fields["bake.size"]["choices"])
    faces = fields["mesh.faces"]
    assert (faces["kind"], faces["whole"], faces["least"], faces["most"]) == ("number", True, 100, 10_000_000)
    assert fields["ingest.invert_masks"]["kind"] == "switch" and fields["targets.files"]["elsewhere"]
    assert (fields["export.up_points"]["kind"], fields["export.up_points"]["numbers"]) == ("list", True)
    assert all(field["help"] for field in found["settings"]) and browser.get("/api/settings?profile=nothing", 400)["error"]


def test_the_plan_estimates_time_and_memory(browser: Browser) -> None:
    write_capture(browser.folder / "a")
    quick, long = (browser.send("POST", "/api/captures/a/plan", {"profile": name}) for name in ("smoke", "quality"))
    assert [stage["name"] for stage in quick["stages"]][:2] == ["ingest", "poses"] and quick["stages"][0]["status"] == "run"
    assert 0 < quick["seconds"] < long["seconds"] and quick["memory"] > 1e8
    other = browser.folder.parent / "other.toml"  # a profile of one's own lies anywhere
    other.write_text('extends = "smoke"', encoding="utf-8")
    assert "no profile" in browser.send("POST", "/api/captures/a/plan", {"profile": str(other)}, 400)["error"]
    assert not (browser.folder / "out").exists()
    details = browser.get("/api/captures/a")
    assert (details["state"], details["done"], details["count"]) == ("new", 0, 4)


@pytest.mark.slow
def test_a_check_says_what_it_found_of_each_photo(browser: Browser) -> None:
    write_capture(browser.folder / "a", 3)
    browser.send("POST", "/api/captures/a/check")
    deadline = time.monotonic() + 60
    while (found := browser.get("/api/captures/a/photos"))["checking"]:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert found["checked"] and found["findings"][0]["level"] == "problem" and not found["error"]
    assert all(row["exposure"] < 0 and row["blurred"] is False for row in found["photos"])
    browser.send("POST", "/api/captures", {"name": "empty"})
    assert "no photos yet" in browser.send("POST", "/api/captures/empty/check", {}, 422)["error"]


def test_masks_are_ordinary_files(browser: Browser) -> None:
    capture = write_capture(browser.folder / "a")
    path = "/api/captures/a/masks/p1.jpg"
    assert not decoded(browser.get(path)).any()
    mask = np.zeros((48, 64), np.uint8)
    mask[10:30, 20:40] = 255
    assert browser.send("PUT", path, encoded(mask))["file"] == "a/masks/p1.png"
    assert np.array_equal(cv2.imread(str(capture / "masks/p1.png"), cv2.IMREAD_GRAYSCALE), mask)
    assert np.array_equal(decoded(browser.get(path)), mask)
    sources = {row["name"]: row["source"] for row in browser.get("/api/captures/a/masks")["photos"]}
    assert sources == {"p0.jpg": "none", "p1.jpg": "file", "p2.jpg": "none", "p3.jpg": "none"}
    browser.send("PUT", path, encoded(255 - mask))  # the studio's own file is replaced
    assert not (capture / "set-aside").exists()
    cv2.imwrite(str(capture / "masks/p2.png"), mask)
    browser.send("PUT", "/api/captures/a/masks/p2.jpg", encoded(255 - mask))  # another's is kept
    assert np.array_equal(cv2.imread(str(capture / "set-aside/masks/p2.png"), cv2.IMREAD_GRAYSCALE), mask)
    assert "64 × 48" in browser.send("PUT", path, encoded(mask[:20]), 400)["error"]
    assert "the mask" in browser.send("PUT", path, b"no image", 422)["error"]


def test_the_next_run_knows_masks_that_were_made_since(browser: Browser) -> None:
    write_capture(browser.folder / "a")
    browser.send("POST", "/api/captures/a/settings", {"profile": "smoke"})
    project = browser.folder / "out/a/project.json"
    assert json.loads(project.read_text())["masks"] is None
    browser.send("PUT", "/api/captures/a/masks/p1.jpg", encoded(np.zeros((48, 64), np.uint8)))
    assert json.loads(project.read_text())["masks"] == str((browser.folder / "a/masks").resolve())


def test_masks_outside_of_the_capture_are_not_written(browser: Browser, tmp_path: Path) -> None:
    write_capture(browser.folder / "a")
    (tmp_path / "elsewhere").mkdir()
    (browser.folder / "a/masks").symlink_to(tmp_path / "elsewhere")
    browser.ask("PUT", "/api/captures/a/masks/p1.jpg", encoded(np.zeros((48, 64), np.uint8)))
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_masks_behind_links_are_neither_shown_nor_written(browser: Browser, tmp_path: Path) -> None:
    folder = write_capture(browser.folder / "a")
    cv2.imwrite(str(tmp_path / "secret.png"), np.full((48, 64), 255, np.uint8))
    (folder / "masks").mkdir()
    (folder / "masks/p0.png").symlink_to(tmp_path / "secret.png")
    (folder / "images/sub").mkdir()
    (folder / "images/p1.jpg").rename(folder / "images/sub/p1.jpg")
    (tmp_path / "elsewhere").mkdir()
    (folder / "masks/sub").symlink_to(tmp_path / "elsewhere")
    assert not decoded(browser.get("/api/captures/a/masks/p0.jpg")).any()
    assert "link" in browser.send("PUT", "/api/captures/a/masks/sub/p1.jpg", encoded(np.zeros((48, 64), np.uint8)), 400)["error"]
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_smart_stroke_finds_the_border(browser: Browser) -> None:
    """A short line over the disc gives the disc, one over ground that the mask holds takes it away; what is far away stays."""
    image = photo(0, (320, 240))
    disc = cv2.circle(np.zeros((240, 320), np.uint8), (160, 120), 60, 255, -1) > 0
    stroke = cv2.line(np.zeros((240, 320), np.uint8), (140, 120), (180, 130), 255, 8) > 0
    far = np.zeros((240, 320), np.uint8)
    far[:8, :8] = 255
    none = np.zeros((240, 320), bool)
    found = grab_cut(image, far, stroke, none)
    assert ((found > 0)[disc].mean() > 0.97) and (found > 0)[~disc].mean() < 0.01 and found[:8, :8].all()
    much = np.where(cv2.rectangle(np.zeros((240, 320), np.uint8), (200, 60), (290, 180), 1, -1) > 0, 255, found).astype(np.uint8)
    ground = cv2.line(np.zeros((240, 320), np.uint8), (240, 90), (260, 150), 255, 8) > 0
    less = grab_cut(image, much, none, ground) > 0
    assert less[disc].mean() > 0.95 and less[60:180, 225:290].mean() < 0.02
    write_capture(browser.folder / "a")
    sent = np.zeros((48, 64, 3), np.uint8)
    assert "no stroke" in browser.send("POST", "/api/captures/a/masks/p0.jpg", encoded(sent), 400)["error"]
    sent[20:28, 28:36, 1] = 255
    assert decoded(browser.send("POST", "/api/captures/a/masks/p0.jpg", encoded(sent)))[24, 32] == 255


def test_the_scene_is_in_the_frame_of_the_region_and_of_up(posed: Browser) -> None:
    found = posed.get("/api/captures/a/scene")
    assert [camera["source"] for camera in found["cameras"]] == ["p0.jpg", "p1.jpg", "p2.jpg"] and found["radius"] == 2.0
    assert np.allclose(found["cameras"][0]["centre"], (6.5, 0, 2)) and np.allclose(found["centre"], (0.5, 0, 1))
    corners = np.array(found["cameras"][0]["corners"])
    assert np.allclose(corners.mean(0) / np.linalg.norm(corners.mean(0)), np.array((-6, 0, -1)) / np.sqrt(37), atol=1e-6)
    content = posed.get("/api/captures/a/scene/points")
    assert np.allclose(np.frombuffer(content[:24], "<f4").reshape(2, 3), [(0.5, 0, 1), (1.5, 0, 1.5)])
    assert content[24:] == b"\xff\0\0\0\x09\0"


def test_the_epipolar_line_passes_where_the_point_is(posed: Browser) -> None:
    (path,) = (posed.folder / "out/a/stages/poses").glob("*/photo_cameras.json")
    cameras = CameraSet.load(path).cameras
    point = np.array([(0.7, 0.1, 1.2)])
    (x, y), other = cameras[0].project(point)[0][0], cameras[1].project(point)[0][0]
    scale = np.array((64 / cameras[0].width, 48 / cameras[0].height))
    body = {"photo": "p0.jpg", "other": "p1.jpg", "x": x * scale[0], "y": y * scale[1]}
    line = np.array(posed.send("POST", "/api/captures/a/scene/epipolar", body)["line"])
    from_line = other * scale - line[:-1]
    along = np.diff(line, axis=0)
    share = np.clip((from_line * along).sum(1) / (along**2).sum(1), 0, 1)
    assert np.linalg.norm(from_line - share[:, None] * along, axis=1).min() < 0.05
    assert "outside the photo" in posed.send("POST", "/api/captures/a/scene/epipolar", {**body, "x": 900}, 422)["error"]
    assert "not registered" in posed.send("POST", "/api/captures/a/scene/epipolar", {**body, "other": "p3.jpg"}, 422)["error"]


def test_doubtful_masks_and_photos_without_a_camera_are_marked(posed: Browser) -> None:
    rows = posed.get("/api/captures/a/masks")["photos"]
    assert rows[0]["name"] == "p2.jpg" and [row["doubtful"] for row in rows] == [True, False, False, False]
    assert [row.get("registered") for row in posed.get("/api/captures/a/photos")["photos"]] == [None, None, None, False]


def test_only_published_files_are_served_and_the_report_is_kept_apart(browser: Browser) -> None:
    write_capture(browser.folder / "a")
    out = browser.folder / "out/a"
    out.mkdir(parents=True)
    for name in ("asset.glb", "asset_web.glb", "report.html", "project.json", "secret.txt"):
        (out / name).write_text("{}")
    glb = browser.ask("GET", "/api/captures/a/files/asset.glb")
    assert glb.code == 200 and glb.headers["content-type"] == "model/gltf-binary" and "content-disposition" not in glb.headers
    assert "attachment" in browser.ask("GET", "/api/captures/a/files/asset_web.glb?download").headers["content-disposition"]
    report = browser.ask("GET", "/api/captures/a/files/report.html").headers["content-security-policy"]
    assert report.startswith("sandbox") and "allow-same-origin" not in report
    browser.get("/api/captures/a/files/project.json", 404)
    browser.get("/api/captures/a/files/secret.txt", 404)
    found = browser.get("/api/captures/a/asset")
    assert set(found["files"]) == {"asset.glb", "asset_web.glb", "report.html"} and found["files"]["asset_web.glb"]["target"]
    assert [row["name"] for row in found["budgets"]][-1] == "surfels"


def test_a_run_is_a_process_of_its_own(browser: Browser) -> None:
    """One that cannot use the photos tells why; a second start is refused while it is in progress."""
    write_capture(browser.folder / "a", 2)
    browser.send("POST", "/api/captures/a/settings", {"profile": "smoke"})
    assert browser.send("POST", "/api/captures/a/run", {"until": "ingest"}) == {"started": True}
    assert "in progress" in browser.send("POST", "/api/captures/a/run", {}, 400)["error"]
    deadline = time.monotonic() + 60
    while (found := browser.get("/api/captures/a/run"))["runs"] or found["starting"]:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert "2 usable photos" in found["message"] and found["exit_code"] == 42
    while psutil.pid_exists(found["pid"]):  # the server reaps it when it is asked
        assert time.monotonic() < deadline
        time.sleep(0.1)
        browser.get("/api/captures/a/run")
    assert "No run of a is in progress" in browser.send("DELETE", "/api/captures/a/run", {}, 400)["error"]
    assert browser.send("POST", "/api/captures/a/run", {"until": "cake"}, 400)["error"] == "There is no such stage."
