"""Models of parts of a capture become one, and only where points tie them together."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsbake.capture.colmap import pycolmap
from gsbake.capture.sfm.features import FeatureOptions
from gsbake.capture.sfm.merging import common_points, merge, merge_all
from gsbake.capture.sfm.reconstruction import Lens, SfmPipeline, largest

PHOTOS, POINTS = 10, 150


@pytest.fixture
def whole(tmp_path: Path) -> Any:
    """A true model of `PHOTOS` photos, whose features and matches lie in `tmp_path/database.db`."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, PHOTOS, POINTS
    options.camera_has_prior_focal_length = True
    pycolmap.set_random_seed(3)
    with closing(pycolmap.Database.open(str(tmp_path / "database.db"))) as base:
        return pycolmap.synthesize_dataset(options, base)


def part(whole: Any, photos: range, transform: Any | None = None) -> Any:
    """The model of some photos, moved by a similarity."""
    model = pycolmap.Reconstruction(whole)
    for index, number in enumerate(sorted(whole.reg_image_ids())):
        if index not in photos:
            model.deregister_frame(model.image(number).frame_id)
    if transform is not None:
        model.transform(transform)
    return model


def elsewhere() -> Any:
    return pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.1, 0.3, -0.2, 0.92])), np.array([1.0, -2.0, 3.0]))


def centres(model: Any) -> dict[int, Any]:
    return {number: np.asarray(model.image(number).projection_center()) for number in model.reg_image_ids()}


@pytest.mark.parametrize("shared", [0, 1, 3])
def test_two_parts_become_one(whole: Any, tmp_path: Path, shared: int) -> None:
    """Photos that both register tie them together, or pairs of photos whose matches were verified."""
    first, second = part(whole, range(6)), part(whole, range(6 - shared, PHOTOS), elsewhere())
    joint = merge(first, second, tmp_path / "database.db", tmp_path, tmp_path / "work", 0)
    assert joint is not None and not (tmp_path / "work").exists()
    true, found = centres(whole), centres(joint)
    assert found.keys() == true.keys() and joint.num_points3D() == POINTS
    assert all(np.allclose(found[number], true[number], atol=1e-4) for number in true)
    assert centres(first).keys() == dict(list(true.items())[:6]).keys()  # its own photos alone, as before


def test_common_points_are_the_same_points(whole: Any, tmp_path: Path) -> None:
    transform = elsewhere()
    first, second = part(whole, range(5)), part(whole, range(5, PHOTOS), transform)
    with closing(pycolmap.Database.open(str(tmp_path / "database.db"))) as base:
        source, target = common_points(second, first, base)
    assert source.shape == target.shape == (POINTS, 3)
    rotation = np.asarray(transform.rotation.matrix())
    assert np.allclose(source, transform.scale * target @ rotation.T + transform.translation, atol=1e-9)


def test_parts_that_moved_against_each_other_stay_apart(whole: Any, tmp_path: Path) -> None:
    """Matched points that no similarity brings together, as of a room behind an object that was turned."""
    second = part(whole, range(5, PHOTOS))
    rng = np.random.default_rng(1)
    for point in second.points3D.values():
        point.xyz = rng.normal(0, 1, 3)
    assert merge(part(whole, range(6)), second, tmp_path / "database.db", tmp_path, tmp_path / "work", 0) is None


def test_an_alignment_that_photos_contradict_is_refused(whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points that are aligned by a wrong similarity are not seen from both parts after the filter."""
    wrong = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.array([0.0, 0.0, 1.0, 0.0])), np.zeros(3))
    monkeypatch.setattr("gsbake.capture.sfm.merging._similarity", lambda *_: wrong)
    assert merge(part(whole, range(6)), part(whole, range(5, PHOTOS)), tmp_path / "database.db", tmp_path, tmp_path / "work", 0) is None


def test_all_parts_that_can_be_tied_are_merged(whole: Any, tmp_path: Path) -> None:
    first, second, third = part(whole, range(4)), part(whole, range(3, 8), elsewhere()), part(whole, range(7, PHOTOS))
    for point in third.points3D.values():
        point.xyz = point.xyz * np.array([1.0, 3.0, -2.0])  # no similarity
    joint = merge_all(first, [third, first, second], tmp_path / "database.db", tmp_path, tmp_path / "work", 0)
    assert sorted(joint.reg_image_ids()) == sorted(whole.reg_image_ids())[:8]
    assert merge_all(first, [], tmp_path / "database.db", tmp_path, tmp_path / "work", 0) is first


def test_models_left_apart_are_merged_as_a_step_of_registration(whole: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mapping is replaced by one that finds two parts, and neither weaker thresholds nor a new start join them."""
    names = tuple(sorted(image.name.removesuffix(".png") for image in whole.images.values()))
    options = FeatureOptions(2048, 0.01, 1024, False)
    pipeline = SfmPipeline(tmp_path, tmp_path, [Lens(names, 1024, 768)], None, options, 1, 0, lambda *_: None)
    parts = [part(whole, range(6)), part(whole, range(5, PHOTOS), elsewhere())]

    def mapping(relaxed: bool, initial: Any | None) -> Any:
        pipeline._models += [] if initial is not None else parts
        return largest(parts)

    monkeypatch.setattr(pipeline, "features", lambda: None)
    monkeypatch.setattr(pipeline, "_incremental", mapping)
    (tmp_path / "matches.done").touch()
    model = pipeline.solve("exhaustive", "incremental")
    assert pipeline.missing(model) == []
    assert pipeline.steps[0] == ("strict thresholds", 6) and pipeline.steps[-1] == ("merging of models", PHOTOS)
