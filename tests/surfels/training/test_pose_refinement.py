"""Corrections of photos: their algebra, finding them from a picture, and making them while surfels train, where that gains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Profile
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.surfels.initialisation import fibonacci_sphere, spacing
from gsbake.surfels.model import Surfels, create
from gsbake.surfels.raster.gbuffer import rasterise, rendered_image
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.training import alignment as align
from gsbake.surfels.training.corrections import Correction, equalised, rotated, then, turned_by, without_common
from gsbake.surfels.training.pose_refinement import LEAST_DB, LEAST_GAIN, LEAST_MOVE, Aligner, Corrected, Look, gained, worth_trying
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.training.views import TrainView, held_out

SIZE = 96
BACK = torch.tensor([0.2, 0.3, 0.5])


def ball(count: int = 3000) -> Surfels:
    """An ellipsoid (.8, .7, .6) with coloured stripes, which looks different from everywhere, of `count` surfels."""
    p = fibonacci_sphere(count)
    stripes = 0.5 + 0.4 * np.stack([np.sin(9 * p[:, 0]), np.sin(8 * p[:, 1] + 1), np.cos(7 * p[:, 2])], 1)
    axes = np.array([0.8, 0.7, 0.6])
    normals = p / axes
    return create(axes * p, normals / np.linalg.norm(normals, axis=1, keepdims=True), spacing(p), stripes, "colour", 0, 0.001, 4.5)


def view_from(eye: Tensor, name: str = "a") -> TrainView:
    """A camera at `eye` (3,) that looks at the origin; its photo is black."""
    z = -eye / eye.norm()
    x = torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0]))
    x = x / x.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    lens = Pinhole(SIZE, SIZE, 1.3 * SIZE, 1.3 * SIZE, 0.51 * SIZE, 0.49 * SIZE)
    return TrainView(name, torch.zeros(3, SIZE, SIZE, dtype=torch.uint8), None, rotation, -rotation @ eye, eye, lens)


def photographed(surfels: Surfels, view: TrainView) -> TrainView:
    """The view with what its camera sees of the surfels as its photo and mask."""
    with torch.no_grad():
        out = rasterise(surfels, view)
        straight = rendered_image(out.planes, view, None) / out.alpha.clamp_min(0.05)
    rgb, mask = ((255 * x).round().clamp(0, 255).to(torch.uint8) for x in (straight, out.alpha))
    return replace(view, rgb=rgb, mask=mask)


def pixels_apart(a: TrainView, b: TrainView) -> float:
    """Root mean square distance in pixels of where two cameras see a ball's surface, told by the plain camera."""
    points = 0.7 * fibonacci_sphere(200)
    lens = a.pinhole
    seen = [Camera("", SIZE, SIZE, lens.fx, lens.fy, lens.cx, lens.cy, v.R.numpy(), v.t.numpy()).project(points)[0] for v in (a, b)]
    return float(np.sqrt(((seen[0] - seen[1]) ** 2).sum(1).mean()))


TWIST = torch.tensor([0.02, -0.015, 0.03, 0.02, -0.01, 0.06], dtype=torch.float64)


def test_rotation_vectors() -> None:
    expected = Rotation.from_rotvec(TWIST[:3].numpy()).as_matrix()
    assert np.allclose(rotated(TWIST[:3]).numpy(), expected, atol=1e-14)
    assert np.allclose(turned_by(rotated(TWIST[:3])).numpy(), TWIST[:3].numpy(), atol=1e-14)
    assert turned_by(torch.eye(3, dtype=torch.float64)).tolist() == [0, 0, 0]


def test_two_twists_are_one_after_the_other() -> None:
    view, other = view_from(torch.tensor([2.5, 1.0, 0.7])), torch.flip(TWIST, [0])
    at_once = Correction(then(TWIST, other), torch.zeros(3)).of(view)
    in_turn = Correction(other, torch.zeros(3)).of(Correction(TWIST, torch.zeros(3)).of(view))
    assert torch.allclose(at_once.R, in_turn.R, atol=1e-6) and torch.allclose(at_once.t, in_turn.t, atol=1e-6)
    assert torch.allclose(-at_once.R.T @ at_once.t, at_once.centre, atol=1e-6)


def test_a_rotation_leaves_the_objects_centre_where_it_is() -> None:
    view = view_from(torch.tensor([2.5, 1.0, 0.7]))
    turned = Correction(torch.cat([TWIST[:3], torch.zeros(3).double()]), torch.zeros(3)).of(view)
    assert torch.equal(turned.t, view.t) and not torch.equal(turned.R, view.R)


def test_a_camera_file_says_what_training_saw() -> None:
    view = view_from(torch.tensor([2.5, 1.0, 0.7]))
    lens = view.pinhole
    camera = Camera("a", SIZE, SIZE, lens.fx, lens.fy, lens.cx, lens.cy, view.R.double().numpy(), view.t.double().numpy())
    correction = Correction(TWIST, torch.zeros(3).double())
    moved, seen = correction.camera(camera), correction.of(view)
    assert np.allclose(moved.R, seen.R.numpy(), atol=1e-6) and np.allclose(moved.centre, seen.centre.numpy(), atol=1e-6)


def test_the_cameras_in_force_are_the_refined_ones_where_there_are_any(tmp_path: Path) -> None:
    poses, trained = tmp_path / "poses", tmp_path / "trained"
    poses.mkdir()
    trained.mkdir()
    camera = Camera("a", SIZE, SIZE, 100.0, 100.0, 48.0, 48.0, np.eye(3), np.array([0.0, 0.0, 3.0]))
    CameraSet((camera,), poses="solved").save(poses / "cameras.json")
    assert PosedPhotos.open(poses, trained).cameras.cameras[0].t[2] == 3
    CameraSet((replace(camera, t=np.array([0.0, 0.0, 4.0])),), poses="solved").save(trained / "cameras.json")
    assert PosedPhotos.open(poses, trained).cameras.cameras[0].t[2] == 4
    assert PosedPhotos.open(poses).cameras.cameras[0].t[2] == 3


def test_a_gain_is_one_on_linear_light() -> None:
    linear = np.linspace(0.02, 0.5, 20)  # above the curve's toe, with and without the gain
    coded = 1.055 * linear ** (1 / 2.4) - 0.055
    gain = np.array([0.1, -0.2, 0.3])
    exposed = np.stack([1.055 * (linear * np.exp(g)) ** (1 / 2.4) - 0.055 for g in gain])
    back = equalised(torch.from_numpy(exposed)[:, None], torch.from_numpy(gain))
    assert np.allclose(back.numpy()[:, 0], coded, atol=1e-12)


def test_what_all_photos_share_is_taken_away() -> None:
    eyes = torch.from_numpy(3 * fibonacci_sphere(20) + 0.01).float()
    views = [view_from(eye) for eye in eyes]
    turn, shift, growth = Rotation.from_rotvec([2e-4, -3e-4, 1e-4]).as_matrix(), np.array([3e-4, 1e-4, -2e-4]), 4e-4
    corrections = []
    for view in views:
        r, t = view.R.double().numpy(), view.t.double().numpy()
        # the scene x → (1 + growth) turn x + shift seen by the same camera is the scene seen by (r turn, (t + r shift) / (1 + growth))
        omega = Rotation.from_matrix(r @ turn @ r.T).as_rotvec()
        tau = (t + r @ shift) / (1 + growth) - t
        corrections.append(Correction(torch.from_numpy(np.concatenate([omega, tau])), torch.full((3,), 0.1).double()))
    own = torch.tensor([1e-3, 0, 0, 0, 2e-3, 0]).double()
    corrections[4] = Correction(corrections[4].twist + own, corrections[4].gain + 0.2)
    left = without_common(views, corrections)
    others = torch.stack([c.twist for i, c in enumerate(left) if i != 4])
    assert float(others.abs().max()) < 3e-4  # a twentieth of what photo 4 has to itself, and second order
    assert torch.allclose(left[4].twist, own, atol=3e-4)
    assert torch.allclose(left[4].gain, torch.full((3,), 0.19).double()) and torch.allclose(left[0].gain, torch.full((3,), -0.01).double())


def test_flow_is_the_motion_of_points() -> None:
    view = view_from(torch.tensor([2.5, 1.0, 0.7]))
    lens, index = view.pinhole, torch.tensor([40 * SIZE + 50, 20 * SIZE + 70])
    depth = torch.tensor([2.1, 2.4])
    pixel = np.stack([index.numpy() % SIZE + 0.5, index.numpy() // SIZE + 0.5], 1)
    ray = np.column_stack([(pixel - [lens.cx, lens.cy]) / lens.fx, np.ones(2)])
    world = (ray * depth.numpy()[:, None] - view.t.numpy()) @ view.R.numpy()
    moved = align.flow(view, depth, index).double()
    for k in range(6):
        there = []
        for sign in (1, -1):
            step = torch.zeros(6, dtype=torch.float64)
            step[k] = sign * 1e-3
            pose = Rotation.from_rotvec(step[:3].numpy()).as_matrix() @ view.R.double().numpy(), view.t.double().numpy() + step[3:].numpy()
            there.append(Camera("", SIZE, SIZE, lens.fx, lens.fy, lens.cx, lens.cy, *pose).project(world)[0])
        assert np.allclose(moved[:, :, k].numpy(), (there[0] - there[1]) / 2e-3, rtol=2e-3, atol=0.05)


@pytest.mark.parametrize("k", range(6))
def test_the_render_changes_as_gauss_newton_thinks(k: int) -> None:
    surfels, view = ball(), view_from(torch.tensor([2.5, 1.0, 0.7]))
    scene = align.scene_of(surfels, None, True, BACK)
    step = torch.zeros(6, dtype=torch.float64)
    step[k] = 2e-3
    with torch.no_grad():
        here, out = scene.draw(view)
        ahead, behind = (scene.draw(Correction(s * step, torch.zeros(3)).of(view))[0] for s in (1, -1))
        change = align.blurred((ahead - behind) / 2, 1.0)
        smooth = align.blurred(torch.cat([here, out.alpha[None]]), 1.0)
        depth = align.spread_depth(out.expected_depth(), out.alpha, 1.0).flatten()
        index = (depth > 0).nonzero()[:, 0]
        slope = align.gradients(smooth[:3]).flatten(2)[:, :, index]
        told = -torch.einsum("dck,kd->ck", slope, align.flow(view, depth[index], index) @ step.float())
    seen = change.flatten(1)[:, index]
    # turning also reorders overlapping surfels, which no flow tells: noise to the slope of what is seen over what is told
    assert float((told * seen).sum() / (told * told).sum()) == pytest.approx(1, abs=0.12)
    assert float((told - seen).norm() / seen.norm()) < (0.6 if k < 2 else 0.25)


@pytest.mark.parametrize("masked", [True, False])
def test_a_photo_is_brought_to_its_pose_and_exposure(masked: bool) -> None:
    surfels, given = ball(), view_from(torch.tensor([2.5, 1.0, 0.7]))
    wanted = Correction(1.5 * TWIST, torch.zeros(3).double())
    view = photographed(surfels, wanted.of(given))
    gain = torch.tensor([0.12, -0.08, 0.05])
    rgb = (255 * equalised(view.colour(), -gain)).round().clamp(0, 255).to(torch.uint8)
    view = replace(given, rgb=rgb, mask=view.mask if masked else None)
    scene = align.scene_of(surfels, None, masked, BACK if masked else torch.zeros(3))
    truth = wanted.of(given)
    before = pixels_apart(given, truth)
    found = align.align(scene, view, Correction.none(), True, True)
    assert before > 1.5
    assert pixels_apart(found.of(view), truth) < 0.15 * before
    assert torch.allclose(found.gain, gain.double(), atol=0.02)
    assert align.motion(scene, view, found) == pytest.approx(before, rel=0.35)  # of what is seen, not of the whole ball
    used = torch.ones(SIZE, SIZE, dtype=torch.bool)
    assert align.psnr(scene, view, found, used) > align.psnr(scene, view, Correction.none(), used) + 3


def test_only_what_is_asked_for_is_corrected() -> None:
    surfels, given = ball(), view_from(torch.tensor([2.5, 1.0, 0.7]))
    view = replace(photographed(surfels, Correction(TWIST, torch.zeros(3)).of(given)), R=given.R, t=given.t, centre=given.centre)
    scene = align.scene_of(surfels, None, True, BACK)
    exposed = align.align(scene, view, Correction.none(), False, True)
    assert not exposed.twist.any() and exposed.gain.any()
    moved = align.align(scene, view, Correction.none(), True, False)
    assert moved.twist.any() and not moved.gain.any()


def test_where_nothing_is_seen_nothing_is_corrected() -> None:
    surfels, view = ball(), view_from(torch.tensor([2.5, 1.0, 0.7]))
    start = Correction(TWIST, torch.zeros(3).double())
    scene = align.scene_of(surfels, None, False, BACK)
    found = align.align(scene, view, start, True, True, torch.zeros(SIZE, SIZE, dtype=torch.bool))
    assert torch.equal(found.twist, start.twist)


# -- in training

PHOTOS, STEPS = 12, 80


def capture(size: float, exposure: float) -> tuple[list[TrainView], list[TrainView]]:
    """Views with camera errors and exposures of a given size, and the same with the true cameras."""
    draw = torch.Generator().manual_seed(3)
    true = [photographed(ball(), view_from(torch.from_numpy(eye).float())) for eye in 3 * fibonacci_sphere(PHOTOS) * 0.99 + 1e-2]
    unit = torch.tensor([1, 1, 1, 0.7, 0.7, 2]).double()
    errors = [Correction(size * unit * torch.randn(6, generator=draw).double(), torch.zeros(3).double()) for _ in true]
    given = []
    for view, error in zip(true, without_common(true, errors), strict=True):
        gain = exposure * (2 * torch.rand(3, generator=draw) - 1)
        rgb = (255 * equalised(view.colour(), gain)).round().clamp(0, 255).to(torch.uint8)
        given.append(replace(error.of(view), rgb=rgb))
    return given, true


def trainer(views: list[TrainView]) -> Trainer:
    p = Profile.model_validate({"train": {"iterations": STEPS}, "surfels": {"max_count": 1500}})
    t = Trainer(Plan(p.train, p.surfels, p.loss, STEPS, 0.0, False, 0), ball(1000), None, list(views), list(views), held_out(PHOTOS, 4))
    t.background = BACK
    return t


def trained(views: list[TrainView], poses: str, gains: str) -> tuple[Trainer, Aligner]:
    t = trainer(views)
    aligner = Aligner(t, poses, gains)
    while t.done < t.end:
        t.step()
        aligner.visit(lambda: False)
    return t, aligner


def apart(views: list[TrainView], true: list[TrainView]) -> float:
    return float(np.mean([pixels_apart(a, b) for a, b in zip(views, true, strict=True)]))


def test_poses_and_exposures_are_found_where_they_are_off() -> None:
    given, true = capture(0.06, 0.4)
    left, plain = trained(given, "always", "always")
    t, aligner = trained(given, "auto", "auto")
    assert aligner.on == Corrected(True, True) and "a trial gained +" in aligner.evidence
    before = apart(given, true)
    assert before > 1.5 and apart(left.views, true) == before
    assert apart(t.views, true) < 0.6 * before
    assert t.evaluate() > left.evaluate() + 1
    both = Corrected(True, True)
    assert float(aligner.look(both).psnr.mean()) > float(plain.look(both).psnr.mean()) + 0.3


def test_exact_photos_are_left_alone() -> None:
    given, _ = capture(0.0, 0.0)
    t, aligner = trained(given, "auto", "auto")
    assert aligner.on == Corrected(False, False) and "deserve a trial" in aligner.evidence and "gained" not in aligner.evidence
    untouched, _ = trained(given, "always", "always")
    assert all(torch.equal(a, b) for a, b in zip(t.surfels.tensors().values(), untouched.surfels.tensors().values(), strict=True))


def look(move: float, gain: float) -> Look:
    return Look(torch.zeros(4), torch.full((4,), move), gain * torch.tensor([[1.0], [-1.0], [1.0], [-1.0]]).expand(4, 3))


@pytest.mark.parametrize(
    ("move", "gain", "expected"),
    [
        (0.9 * LEAST_MOVE, 0.9 * LEAST_GAIN, Corrected(False, False)),
        (1.1 * LEAST_MOVE, 0.9 * LEAST_GAIN, Corrected(True, False)),
        (0.9 * LEAST_MOVE, 1.1 * LEAST_GAIN, Corrected(False, True)),
    ],
)
def test_what_deserves_a_trial(move: float, gain: float, expected: Corrected) -> None:
    assert worth_trying(look(move, gain), 400)[0] == expected
    assert not worth_trying(look(move, gain), 800)[0].poses  # the same share of a larger photo is more pixels
    common = look(move, gain)
    assert worth_trying(Look(common.psnr, common.move, common.gain + 1), 400)[0] == expected  # one exposure for all is none


@pytest.mark.parametrize(
    ("gains", "holds"),
    [
        ([2 * LEAST_DB] * 5, True),
        ([0.5 * LEAST_DB] * 5, False),
        ([9.0, -0.1, -0.1, -0.1, 0.2], False),  # one photo gains for all
    ],
)
def test_what_a_trial_must_gain(gains: list[float], holds: bool) -> None:
    before = torch.full((5,), 20.0)
    verdict, words = gained(before, before + torch.tensor(gains))
    assert verdict == holds and f"{np.mean(gains):+.2f} dB" in words


def test_a_trial_that_gains_nothing_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    given, _ = capture(0.06, 0.0)
    monkeypatch.setattr("gsbake.surfels.training.pose_refinement.LEAST_DB", 99.0)
    t, aligner = trained(given, "auto", "always")
    assert aligner.on == Corrected(False, False) and "99 dB are needed" in aligner.evidence
    untouched, _ = trained(given, "always", "always")
    assert all(torch.equal(a, b) for a, b in zip(t.surfels.tensors().values(), untouched.surfels.tensors().values(), strict=True))
    assert all(torch.equal(a.R, b.R) and torch.equal(a.rgb, b.rgb) for a, b in zip(t.views, given, strict=True))


def test_a_stopped_trial_is_made_again_and_a_resumed_run_ends_with_the_same_bits(tmp_path: Path) -> None:
    given, _ = capture(0.06, 0.4)
    whole, decided = trained(given, "auto", "auto")
    first = trainer(given)
    aligner = Aligner(first, "auto", "auto")
    asked: list[int] = []

    def stopped() -> bool:
        asked.append(first.done)
        return len(asked) > 5

    while not asked and first.done < first.end:
        first.step()
        aligner.visit(stopped)
    assert aligner.on is None and first.done == asked[0]  # back where the trial began
    torch.save({"trainer": first.state(), "aligner": aligner.state()}, tmp_path / "c.pt")
    body = torch.load(tmp_path / "c.pt", weights_only=True)
    second = trainer(given)
    again = Aligner(second, "auto", "auto")
    second.restore(body["trainer"])
    again.restore(body["aligner"])
    again.visit(lambda: False)
    assert again.on is not None
    for _ in range(3):
        second.step()
        again.visit(lambda: False)
    torch.save({"trainer": second.state(), "aligner": again.state()}, tmp_path / "d.pt")
    body = torch.load(tmp_path / "d.pt", weights_only=True)
    third = trainer(given)
    last = Aligner(third, "auto", "auto")
    third.restore(body["trainer"])
    last.restore(body["aligner"])
    while third.done < third.end:
        third.step()
        last.visit(lambda: False)
    assert last.on == decided.on and last.evidence == decided.evidence
    assert all(torch.equal(a, b) for a, b in zip(third.surfels.tensors().values(), whole.surfels.tensors().values(), strict=True))
    assert all(torch.equal(a.R, b.R) and torch.equal(a.rgb, b.rgb) for a, b in zip(third.views, whole.views, strict=True))
