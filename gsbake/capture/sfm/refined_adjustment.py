"""Bundle adjustment with refined observations, kept where its cameras predict tracks better that it has not seen.

Cameras are judged by tracks left out of the adjustment: their points are triangulated with the cameras held still, and what remains is the
cameras' error and that of the observations, which is the same for all cameras. Refined positions show the difference best. Those of SIFT
are a second, independent witness: a bias of the alignment would not carry over to them. The cameras are better when refined positions are
explained better in more than half of the tracks, by two standard errors of that share, and the error at SIFT's is not larger by a tenth:
the cameras before have the advantage that they were adjusted to these.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.colmap import pycolmap
from gsbake.capture.poses.colmap_model import camera_of
from gsbake.capture.sfm.lenses import is_plausible_lens
from gsbake.capture.sfm.track_refinement import Observations, refine_observations
from gsbake.geometry.cameras import Camera, Similarity

Doubles = NDArray[np.float64]
#: {(image, feature): position (2,)}.
Positions = Mapping[tuple[int, int], Doubles]

#: Of the tracks with at least three refined observations one in so many is left out, up to one in three where that gives too few tracks;
#: fewer than the least number decide nothing.
LEFT_OUT, MOST_LEFT_OUT, ENOUGH_LEFT_OUT, MIN_LEFT_OUT = 10, 3, 40, 30
#: Factor by which the error at SIFT's positions may grow.
TOLERANCE = 1.1
#: Residual in pixels from which an observation loses weight (Cauchy): three times what refined ones have.
LOSS_SCALE = 0.3
#: Largest error in pixels and smallest angle between rays in degrees of what is kept, as in COLMAP's mapping.
MAX_ERROR, MIN_ANGLE = 4.0, 1.5
#: Lens models that are tried, and what they have more than SIMPLE_RADIAL: the second coefficient of the distortion shows where observations
#: are this precise.
LENSES = {"RADIAL": 1, "SIMPLE_RADIAL": 0}


@dataclass(frozen=True)
class Adjusted:
    """The better model, and `figures` for the report; their `decision` is the choice and its evidence."""

    model: Any
    figures: dict[str, Any]


def adjust_refined(model: Any, photos: Path, detected_size: int, tick: Callable[[int, int], None]) -> Adjusted:
    """`model`, or its adjustment to refined observations where that is better; arguments as in `refine_observations`."""
    start = time.perf_counter()
    observed = Observations.of(model)
    refined = refine_observations(model, observed, photos, detected_size, tick)
    keys = [(observed.images[p], int(f)) for p, f in zip(observed.photo, observed.feature, strict=True)]
    positions = {key: refined.xy[k] for k, key in enumerate(keys) if refined.refined[k]}
    lengths = np.bincount(observed.track[refined.refined], minlength=len(observed.track_ids))
    judges = observed.track_ids[lengths >= 3]
    left_out = set(judges[:: max(MOST_LEFT_OUT, min(LEFT_OUT, len(judges) // ENOUGH_LEFT_OUT))].tolist())
    share = float(refined.refined.mean()) if len(keys) else 0.0
    figures: dict[str, Any] = {"used": False, "refined_share": share, "left_out_tracks": len(left_out)}
    if len(left_out) >= MIN_LEFT_OUT:
        test = _Test(model, left_out, positions)
        before = test.errors(model)
        for lens in LENSES:
            trained = _bundle_adjust(_with_lens(_moved(_without(model, left_out), positions), lens))
            if not all(map(is_plausible_lens, _cameras(trained))):
                continue
            _align(trained, model)
            after = test.errors(trained)
            better = [float((a < b).mean()) for a, b in zip(after, before, strict=True)]
            medians = [[float(np.median(b)), float(np.median(a))] for a, b in zip(after, before, strict=True)]
            figures |= {"lens": lens, "refined_px": medians[0], "detected_px": medians[1], "better": better}
            if better[0] > 0.5 + len(left_out) ** -0.5 and medians[1][1] <= TOLERANCE * medians[1][0]:
                all_tracks = _take_cameras(_moved(copy.deepcopy(model), positions), trained)
                model = _bundle_adjust(_bundle_adjust(all_tracks, points_only=True))
                pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_ANGLE)
                figures["used"] = True
                break
    return Adjusted(model, figures | {"decision": _decision(figures), "seconds": time.perf_counter() - start})


def _decision(figures: Mapping[str, Any]) -> tuple[str, str]:
    """What was chosen, and the evidence."""
    if figures["left_out_tracks"] < MIN_LEFT_OUT:
        return "not used", f"{figures['left_out_tracks']} tracks to judge the cameras by, fewer than {MIN_LEFT_OUT}"
    if "refined_px" not in figures:
        return "not used", "the adjusted lenses are none that exist"
    refined, detected = (" → ".join(f"{error:.3f}" for error in figures[key]) for key in ("refined_px", "detected_px"))
    better, as_detected = (f"better in {100 * part:.0f} %" for part in figures["better"])
    evidence = f"{figures['left_out_tracks']} tracks left out: {refined} px ({better}), at SIFT's positions {detected} px ({as_detected})"
    share = f"{100 * figures['refined_share']:.0f} % of the observations"
    return (f"{share}, {figures['lens']} lenses" if figures["used"] else "not used"), evidence


class _Test:
    """Tracks by whose refined and SIFT's `positions` cameras are judged."""

    def __init__(self, model: Any, tracks: set[int], positions: Positions) -> None:
        self._detected = _without(model, set(model.points3D) - tracks)
        for key in sorted(tracks):
            seen = [(element.image_id, element.point2D_idx) for element in self._detected.points3D[key].track.elements]
            for observation in seen:
                if observation not in positions:
                    self._detected.delete_observation(*observation)
        self._refined = _moved(copy.deepcopy(self._detected), positions)

    def errors(self, cameras: Any) -> tuple[Doubles, Doubles]:
        """Mean reprojection error of each track in pixels, of refined and of SIFT's positions, with the cameras of a model."""
        return self._error(self._refined, cameras), self._error(self._detected, cameras)

    @staticmethod
    def _error(tracks: Any, cameras: Any) -> Doubles:
        model = _bundle_adjust(_take_cameras(copy.deepcopy(tracks), cameras), points_only=True)
        model.update_point_3d_errors()
        return np.array([model.points3D[key].error for key in sorted(model.points3D)])


def _without(model: Any, tracks: set[int]) -> Any:
    """A copy of a model without some of its tracks."""
    model = copy.deepcopy(model)
    for key in sorted(tracks):
        model.delete_point3D(key)
    return model


def _moved(model: Any, positions: Positions) -> Any:
    """The model with features at other positions, in place."""
    for (image, feature), xy in positions.items():
        model.images[image].points2D[feature].xy = xy
    return model


def _with_lens(model: Any, lens: str) -> Any:
    """The model, of SIMPLE_RADIAL cameras, with those of another model, in place; what these have more is 0."""
    for camera in model.cameras.values():
        params = list(camera.params)
        camera.model = getattr(pycolmap.CameraModelId, lens)
        camera.params = params + [0.0] * LENSES[lens]
    return model


def _take_cameras(model: Any, other: Any) -> Any:
    """The model with the lenses and poses of another one of the same photos, in place."""
    for key, camera in other.cameras.items():
        model.cameras[key].model, model.cameras[key].params = camera.model, camera.params
    for key, frame in other.frames.items():
        if frame.has_pose():
            model.frames[key].rig_from_world = frame.rig_from_world
    return model


def _cameras(model: Any) -> list[Camera]:
    """The cameras of a model, in the order of its images."""
    return [
        camera_of(model.images[key], model.images[key].name, "the solved model")
        for key in sorted(model.images)
        if model.images[key].has_pose
    ]


def _align(model: Any, other: Any) -> None:
    """Move a model in place to where `other`, of the same photos, has its cameras: adjustment leaves the frame free."""
    to_other = Similarity.between(*(np.stack([camera.centre for camera in _cameras(each)]) for each in (model, other)))
    model.transform(pycolmap.Sim3d(to_other.scale, pycolmap.Rotation3d(to_other.rotation), to_other.translation))


def _bundle_adjust(model: Any, points_only: bool = False) -> Any:
    """Adjust a model in place: all of it, or its points only. One thread: the order of sums does not depend on anything."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = options.refine_rig_from_world = not points_only
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, LOSS_SCALE
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance, options.ceres.solver_options.max_num_iterations = 1e-4, 50
    pycolmap.bundle_adjustment(model, options)
    return model
