"""Report stage on a small finished run with known figures."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Skip
from gsbake.errors import BadInputError
from gsbake.gltf.frame import read_transforms_json
from gsbake.gltf.read import read_glb
from gsbake.report import compose, manifests
from gsbake.report.asset import open_asset
from gsbake.report.lights import LitShader
from gsbake.report.render import Renderer
from gsbake.report.sheets import face_charts, uv_atlas_image
from gsbake.shading.environment import EnvironmentLight
from gsbake.stages.report import STAGE
from tests.report.conftest import Finished
from tests.report.shapes import ball, quad

MakeRun = Callable[..., Finished]


def test_correct_asset_has_high_psnr(make_run: MakeRun) -> None:
    done = make_run()
    found = done.report()
    # The ball is polygonal and the photos are reduced from 64 to 48 pixels: only the silhouette differs.
    assert found["psnr"] > 32 and found["ssim"] > 0.97
    assert found["held_out"] is True and found["compared"] == 1  # the second of the two held-out photos
    body = json.loads((done.out / "report.json").read_text())
    assert [v["name"] for v in body["views"]] == ["IMG_6.a"]
    assert body["psnr"] == pytest.approx(np.mean([v["psnr"] for v in body["views"]]))
    assert done.monitor.progressed[-1][0] == done.monitor.progressed[-1][1]
    assert done.monitor.warnings == []


def test_shifted_asset_has_low_psnr(make_run: MakeRun) -> None:
    assert make_run(shift=1.2).report()["psnr"] < 20


def test_page_shows_the_run(make_run: MakeRun) -> None:
    done = make_run(materials=True)
    found = done.report()
    html = (done.out / "report.html").read_text()
    triangles = f"{found['triangles']:,}".replace(",", " ")
    assert "64 × 64 of 64 × 64 pixels" in html and "per pixel <small>of a photo</small>" in html
    for words in ("grey_ball", "One photo is blurred &amp; dark.", "structure from motion", "8 of 9", "Learnt light", "Sunset", triangles):
        assert words in html
    assert html.count("<span>training photo</span>") == 0
    assert 'id="light-3"' in html
    assert found["seconds"] == pytest.approx(1.5 * 28) and found["peak_bytes"] == 7e8
    assert found["page_bytes"] < 4e6


def test_lit_ball_under_white_light(make_run: MakeRun) -> None:
    # Uniform radiance 1: sRGB 188 is linear .5, the diffuse part; specular reflection adds a few percent.
    found = make_run(materials=True).report()
    assert 20 < found["psnr"] < 40


def test_without_masks_or_held_out_photos(make_run: MakeRun) -> None:
    done = make_run(masks=False, holdout=0)
    found = done.report()
    assert found["held_out"] is False and found["compared"] == 8
    assert found["psnr"] > 28
    html = (done.out / "report.html").read_text()
    assert "no masks" in html and html.count("<span>training photo</span>") == 2


def test_cameras_of_another_run(make_run: MakeRun) -> None:
    done = make_run()
    path = done.folders["export"] / "cameras.json"
    body = json.loads(path.read_text())
    path.write_text(json.dumps(body | {"frames": body["frames"][1:]}))
    with pytest.raises(BadInputError, match="7 cameras for 8 photos"):
        done.report()


def test_settings_declared() -> None:
    assert set(STAGE.settings) == {"report.*", "train.holdout"}
    assert set(STAGE.needs) == set(manifests.ORDER)


def test_light_turns_with_the_frames(make_run: MakeRun) -> None:
    done = make_run()
    cameras = read_transforms_json(done.folders["export"] / "cameras.json")
    posed = PosedPhotos.open(done.folders["poses"])
    to_light = compose.light_rotation(cameras[3], posed.cameras.cameras[3])
    # By the contract: unit → world by the similarity, world → asset by (x, y, z) → (x, z, −y).
    up = posed.cameras.to_world.rotation @ np.array([0.3, 0.5, -0.7])
    np.testing.assert_allclose(to_light @ [up[0], up[2], -up[1]], [0.3, 0.5, -0.7], atol=1e-9)


def test_open_asset_decodes_the_textures(make_run: MakeRun) -> None:
    path = make_run().folders["export"] / "asset.glb"
    asset = open_asset(path, unlit=True)
    np.testing.assert_allclose(asset.base_color, 0.5029, atol=1e-3)  # sRGB 188
    assert asset.orm is not None and asset.normal_map is not None
    np.testing.assert_allclose(asset.orm[0, 0], [1, 1, 0])
    np.testing.assert_allclose(asset.normal_map[0, 0], [0, 0, 1], atol=5e-3)
    assert asset.unlit and not asset.wrap and asset.tangent is not None
    assert len(asset.faces) == len(read_glb(path).faces)
    path.write_bytes(b"not a model")
    with pytest.raises(BadInputError, match="asset.glb"):
        open_asset(path)


def test_framed_camera_sees_all() -> None:
    shape = ball(2.0)
    for direction in ([0, 0, 1.0], [1, 0.4, -0.3], [0, 1.0, 0]):
        camera = compose.framing_camera(shape, np.array(direction), 100)
        np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.R) > 0
        pixels, depth = camera.project(shape.position)
        assert depth.min() > 0 and pixels.min() > -0.5 and pixels.max() < 100.5
        assert np.ptp(pixels[:, 0]) > 95
    side = compose.framing_camera(shape, np.array([0, 0, 1.0]), 100)
    above = side.project(np.array([[0, 1.0, 0]]))[0][0]
    assert above[1] < 50 and above[0] == pytest.approx(50)


def test_viewpoints_are_spread() -> None:
    shape = ball(1.0)
    cameras = [compose.framing_camera(shape, np.array([np.sin(a), 0.35, np.cos(a)]), 8) for a in np.linspace(0, 2 * np.pi, 12, False)]
    found = compose.viewpoints(shape, cameras, 2)
    assert len(found) == 2 and found[0] @ found[1] < -0.7
    assert len(compose.viewpoints(shape, cameras[:1], 3)) == 1


def test_relit_panels_differ_by_light() -> None:
    renderer = Renderer(ball(1.0, rows=24))
    learnt = LitShader(EnvironmentLight.from_radiance(np.ones((6, 8, 8, 3), np.float32)))
    panels, lights = compose.relit_panels(renderer, learnt, [np.array([0, 0, 1.0])], 32, lambda k, n: None)
    assert [p.title for p in panels] == ["Learnt light", "Studio", "Sunset"] == [light.name for light in lights]
    assert len({p.image for p in panels}) == 3
    panels, lights = compose.relit_panels(renderer, None, [np.array([0, 0, 1.0])], 32, lambda k, n: None)
    assert [p.title for p in panels] == ["As photographed"] and lights == ()


def test_the_fitted_light_says_how_certain_it_is() -> None:
    learnt = LitShader(EnvironmentLight.from_radiance(np.ones((6, 8, 8, 3), np.float32)))
    found = {"light_factor_low": 0.634, "light_factor_high": 1.55}
    assert compose.panorama(learnt, found).caption == "white is a radiance of 1; a factor of 0.63 to 1.55 on it is open"
    for known in (found | {"white_factor": [1.1] * 3}, {}):
        assert compose.panorama(learnt, known).caption == "white is a radiance of 1"


def test_charts_of_the_atlas() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]], np.int32)
    found = face_charts(faces, 7)
    assert found[0] == found[1] != found[2] and found.max() == 1


def test_uv_sheet_covers_what_the_triangles_cover() -> None:
    shape = quad(np.ones((2, 2, 3)))
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.5], [0.25, 0.5]], np.float32)
    sheet = uv_atlas_image(type(shape)(shape.position, shape.normal, shape.tangent, uv, shape.faces, shape.base_color), edge=64)
    assert sheet[24, 24].max() > 0.4 and sheet[24, 40].max() > 0.4  # v = .375: row 24
    np.testing.assert_allclose(sheet[[8, 40, 24, 24], [24, 24, 8, 56]], 34 / 255, atol=0.01)


def test_manifests_may_lack_everything(tmp_path: Path) -> None:
    folder = tmp_path / "mesh"
    folder.mkdir()
    found = manifests.load_manifests({"mesh": folder})
    assert found == {"mesh": {}}
    assert manifests.total_seconds(found) == 0 and manifests.peak(found) == (0.0, "")
    assert "replaced" in manifests.time_chart(found) and manifests.stage_rows(found)[0].title == "mesh"
    assert manifests.decisions(found) == () and manifests.warnings(found) == () and manifests.capture_name(found) == "Asset"
    assert "0.0 s" in manifests.run_note(found)


def test_every_skip_rule_is_listed() -> None:
    done = {"what": "skip.converged_steps", "choice": "stopped", "evidence": "plateau", "saved_s": 75.0}
    found = {
        "poses": {"decisions": [{"what": "skip.redundant_photos", "choice": "all used", "evidence": "0 of 9"},
                                {"what": "matching", "choice": "x"}]},
        "train": {"decisions": [done]},
        "refine": {"decisions": [done | {"choice": "all steps", "saved_s": None}]},
    }
    rows = manifests.skip_decisions(found)
    assert list(dict.fromkeys(row.rule for row in rows)) == [f"skip.{rule}" for rule in Skip.model_fields]
    by_stage = {(row.rule, row.stage): row for row in rows}
    assert by_stage["skip.converged_steps", "train"].saved == "about 1 min 15 s"
    assert by_stage["skip.converged_steps", "refine"].saved == "" and by_stage["skip.redundant_photos", "poses"].evidence == "0 of 9"
    assert by_stage["skip.exposure_equalisation", ""].choice == "not applicable"
    assert [d.what for d in manifests.decisions(found)] == ["matching"]
    assert manifests.skip_decisions({"mesh": {}}) == ()


@pytest.mark.parametrize(
    ("path", "name"), [("/a/rose/photos", "rose"), ("/a/rose", "rose"), ("/a/rose/Images", "rose"), ("photos", "Asset"), ("", "Asset")]
)
def test_capture_name(path: str, name: str) -> None:
    assert manifests.capture_name({"ingest": {"inputs": {"photos": {"path": path}}}}) == name


def test_steps_of_refine_follow_those_of_train() -> None:
    train, refine = {"step": [0.0, 100.0], "psnr": [20.0, 25.0]}, {"step": [0.0, 50.0], "psnr": [25.0, 26.0]}
    (chart,) = manifests.training_charts({"train": train, "refine": refine})
    lines = {c: [float(p.split(",")[0]) for p in points.split()] for c, points in re.findall(r'class="(c\d)" points="([^"]+)"', chart)}
    assert lines["c0"][1] == pytest.approx(lines["c1"][0])
    assert lines["c1"][1] - lines["c1"][0] == pytest.approx((lines["c0"][1] - lines["c0"][0]) / 2, abs=0.2)
    assert manifests.training_charts({"train": {}, "refine": {}}) == ()


def test_damaged_log_and_audit(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "log.csv").write_text("step,psnr\n1,abc\n")
    with pytest.raises(BadInputError, match="log.csv"):
        manifests.read_log(folder / "log.csv")
    assert manifests.read_log(folder / "none.csv") == {}
    (folder / "audit.json").write_text("{}")
    with pytest.raises(BadInputError, match="audit"):
        manifests.audit_rows(folder / "audit.json")
    assert manifests.audit_rows(folder / "none.json") == ()


def test_audit_states(tmp_path: Path) -> None:
    cases = ((True, "error"), (False, "error"), (False, "warning"), (False, "info"))
    rows = [{"rule": "r", "passed": p, "detail": 3, "severity": s} for p, s in cases]
    (tmp_path / "audit.json").write_text(json.dumps(rows))
    found = manifests.audit_rows(tmp_path / "audit.json")
    assert [c.state for c in found] == ["pass", "fail", "warn", "info"] and found[0].detail == "3"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "yes"), (3, "3"), (0.123456, "0.1235"), (15_000.0, "15 000"), (30_000, "30 000"), ([1, 2.5], "1, 2.5"), ({"a": 1}, "a: 1"),
        (None, "–"), ([], "–"), ([7] * 20, "(20)"),
    ],
)  # fmt: skip
def test_format_value(value: object, text: str) -> None:
    assert text in manifests.format_value(value)
