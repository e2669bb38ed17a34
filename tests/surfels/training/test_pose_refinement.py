"""Pose and exposure refinement during training: when it is tried, and what trials decide."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsbake.capture.exposure import MAX_SPREAD
from gsbake.capture.photos.roles import held_out
from gsbake.capture.photos.undistortion import image_plane
from gsbake.capture.sfm.epipolar import sampson_distances
from gsbake.checkpoint import load_checkpoint, save_checkpoint
from gsbake.config.schema import Profile
from gsbake.geometry.cameras import Camera, CameraSet
from gsbake.monitor import Rule
from gsbake.surfels.initialisation import fibonacci_sphere
from gsbake.surfels.training.corrections import Correction, CorrectionKinds, equalise_exposure, remove_gauge
from gsbake.surfels.training.pose_refinement import (
    EPIPOLAR_SHARE,
    MIN_LOG_GAIN,
    MIN_MOTION,
    MIN_PSNR_GAIN,
    Aligner,
    AlignmentResult,
    exposure_rule,
    needs_trial,
    pose_rule,
    trial_improves,
)
from gsbake.surfels.training.trainer import Plan, Trainer
from gsbake.surfels.views import TrainView
from tests.surfels.training.scenes import BACK, ball, camera_of, photographed, pixels_apart, view_from

PHOTOS, STEPS = 12, 80


def capture(size: float, exposure: float) -> tuple[list[TrainView], list[TrainView]]:
    """Views with pose errors and exposures of a given size, and the same views with true cameras."""
    draw = torch.Generator().manual_seed(3)
    true = [photographed(ball(), view_from(torch.from_numpy(eye).float())) for eye in 3 * fibonacci_sphere(PHOTOS) * 0.99 + 1e-2]
    unit = torch.tensor([1, 1, 1, 0.7, 0.7, 2]).double()
    errors = [Correction(size * unit * torch.randn(6, generator=draw).double(), torch.zeros(3).double()) for _ in true]
    given = []
    for view, error in zip(true, remove_gauge(true, errors), strict=True):
        gain = exposure * (2 * torch.rand(3, generator=draw) - 1)
        rgb = (255 * equalise_exposure(view.colour(), gain)).round().clamp(0, 255).to(torch.uint8)
        given.append(replace(error.apply(view), rgb=rgb))
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
        aligner.update(lambda: False)
    return t, aligner


def apart(views: list[TrainView], true: list[TrainView]) -> float:
    return float(np.mean([pixels_apart(a, b) for a, b in zip(views, true, strict=True)]))


def test_pose_and_exposure_errors_are_corrected() -> None:
    given, true = capture(0.06, 0.4)
    left, plain = trained(given, "skip", "skip")
    t, aligner = trained(given, "auto", "auto")
    assert aligner.decided == CorrectionKinds(True, True) and "a trial gained +" in aligner.evidence
    before = apart(given, true)
    assert before > 1.5 and apart(left.views, true) == before
    assert apart(t.views, true) < 0.6 * before
    assert t.evaluate() > left.evaluate() + 1
    both = CorrectionKinds(True, True)
    assert float(aligner.measure(both).psnr.mean()) > float(plain.measure(both).psnr.mean()) + 0.3


def test_exact_photos_are_not_corrected() -> None:
    given, _ = capture(0.0, 0.0)
    t, aligner = trained(given, "auto", "auto")
    assert aligner.decided == CorrectionKinds(False, False) and "a trial needs" in aligner.evidence and "gained" not in aligner.evidence
    untouched, _ = trained(given, "skip", "skip")
    assert all(torch.equal(a, b) for a, b in zip(t.surfels.tensors().values(), untouched.surfels.tensors().values(), strict=True))


@pytest.mark.parametrize(
    ("rule", "origin", "error", "expected"),
    [
        ("auto", "solved", None, "skip"),
        ("auto", "given", None, "skip"),  # nothing tells that they are wrong
        ("auto", "given", 0.9 * 2 * EPIPOLAR_SHARE * MIN_MOTION, "skip"),
        ("auto", "given", 1.1 * 2 * EPIPOLAR_SHARE * MIN_MOTION, "auto"),
        ("keep", "solved", None, "keep"),
        ("skip", "given", 9.0, "skip"),
    ],
)
def test_poses_are_tried_where_matched_features_contradict_them(rule: Rule, origin: str, error: float | None, expected: Rule) -> None:
    camera = Camera("a", 800, 600, 900.0, 900.0, 400.0, 300.0, np.eye(3), np.array([0.0, 0.0, 3.0]))
    found, reason = pose_rule(rule, CameraSet((camera,), poses=origin, epipolar_px=error), 400)  # trained at half the size
    assert found == expected and bool(reason) == (found != rule)


@pytest.mark.parametrize(
    ("rule", "spread", "expected"),
    [
        ("auto", None, "skip"),  # nothing tells that they differ
        ("auto", MAX_SPREAD - 0.02, "skip"),
        ("auto", MAX_SPREAD + 0.02, "auto"),
        ("keep", None, "keep"),
        ("skip", 2.0, "skip"),
    ],
)
def test_exposures_are_tried_where_tie_points_differ(rule: Rule, spread: float | None, expected: Rule) -> None:
    found, reason = exposure_rule(rule, spread)
    assert found == expected and bool(reason) == (found != rule)


def test_epipolar_share_is_that_of_normal_errors() -> None:
    rng = np.random.default_rng(0)
    eyes = [torch.tensor([3.0, 0.2, 0.4]), torch.tensor([2.6, 1.5, 0.4])]
    points, errors, distances = 0.7 * fibonacci_sphere(200), [], []
    for _ in range(300):
        true = [view_from(eye) for eye in eyes]
        wrong = [Correction(torch.tensor(rng.normal(0, [4e-3] * 3 + [0.012] * 3)), torch.zeros(3).double()).apply(view) for view in true]
        errors.append([pixels_apart(a, b) for a, b in zip(true, wrong, strict=True)])
        a, b = (camera_of(view) for view in wrong)
        planes = [image_plane(camera, camera.project(points)[0]) for camera in map(camera_of, true)]
        distances.append(np.median(sampson_distances(a, b, *planes)))
    assert np.median(distances) == pytest.approx(EPIPOLAR_SHARE * np.sqrt(np.mean(np.square(errors))), rel=0.25)


def measure(motion: float, gain: float) -> AlignmentResult:
    return AlignmentResult(torch.zeros(4), torch.full((4,), motion), gain * torch.tensor([[1.0], [-1.0], [1.0], [-1.0]]).expand(4, 3))


@pytest.mark.parametrize(
    ("motion", "gain", "expected"),
    [
        (0.9 * MIN_MOTION, 0.9 * MIN_LOG_GAIN, CorrectionKinds(False, False)),
        (1.1 * MIN_MOTION, 0.9 * MIN_LOG_GAIN, CorrectionKinds(True, False)),
        (0.9 * MIN_MOTION, 1.1 * MIN_LOG_GAIN, CorrectionKinds(False, True)),
    ],
)
def test_trial_thresholds(motion: float, gain: float, expected: CorrectionKinds) -> None:
    assert needs_trial(measure(motion, gain), 400)[0] == expected
    assert not needs_trial(measure(motion, gain), 800)[0].poses  # the threshold grows with the photo
    common = measure(motion, gain)
    assert needs_trial(AlignmentResult(common.psnr, common.motion, common.gain + 1), 400)[0] == expected  # a common exposure does not count


@pytest.mark.parametrize(
    ("gains", "holds"),
    [
        ([2 * MIN_PSNR_GAIN] * 5, True),
        ([0.5 * MIN_PSNR_GAIN] * 5, False),
        ([9.0, -0.1, -0.1, -0.1, 0.2], False),  # a single photo improves
    ],
)
def test_trial_success(gains: list[float], holds: bool) -> None:
    before = torch.full((5,), 20.0)
    verdict, evidence = trial_improves(before, before + torch.tensor(gains))
    assert verdict == holds and f"{np.mean(gains):+.2f} dB" in evidence


def test_failed_trial_leaves_training_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    given, _ = capture(0.06, 0.0)
    monkeypatch.setattr("gsbake.surfels.training.pose_refinement.MIN_PSNR_GAIN", 99.0)
    t, aligner = trained(given, "auto", "skip")
    assert aligner.decided == CorrectionKinds(False, False) and "99 dB are needed" in aligner.evidence
    untouched, _ = trained(given, "skip", "skip")
    assert all(torch.equal(a, b) for a, b in zip(t.surfels.tensors().values(), untouched.surfels.tensors().values(), strict=True))
    assert all(torch.equal(a.R, b.R) and torch.equal(a.rgb, b.rgb) for a, b in zip(t.views, given, strict=True))


@pytest.mark.slow
def test_stopped_trial_is_repeated_and_resumed_run_is_bit_identical(tmp_path: Path) -> None:
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
        aligner.update(stopped)
    assert aligner.decided is None and first.done == asked[0]  # restored to the start of the trial
    save_checkpoint(tmp_path / "c", {"trainer": first.state(), "aligner": aligner.state()})
    body = load_checkpoint(tmp_path / "c")
    second = trainer(given)
    again = Aligner(second, "auto", "auto")
    second.restore(body["trainer"])
    again.restore(body["aligner"])
    again.update(lambda: False)
    assert again.decided is not None
    for _ in range(3):
        second.step()
        again.update(lambda: False)
    save_checkpoint(tmp_path / "d", {"trainer": second.state(), "aligner": again.state()})
    body = load_checkpoint(tmp_path / "d")
    third = trainer(given)
    last = Aligner(third, "auto", "auto")
    third.restore(body["trainer"])
    last.restore(body["aligner"])
    while third.done < third.end:
        third.step()
        last.update(lambda: False)
    assert last.decided == decided.decided and last.evidence == decided.evidence
    assert all(torch.equal(a, b) for a, b in zip(third.surfels.tensors().values(), whole.surfels.tensors().values(), strict=True))
    assert all(torch.equal(a.R, b.R) and torch.equal(a.rgb, b.rgb) for a, b in zip(third.views, whole.views, strict=True))
