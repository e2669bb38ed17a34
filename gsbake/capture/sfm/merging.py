"""Merging of models that mapping left apart, because few photos tie two parts of a capture together.

A photo that both models register, and a verified pair of photos of which each model registers one, show the same points in both. These
correspondences of 3D points give the similarity between the models, by LO-RANSAC with Umeyama's solution (Chum et al., *Locally optimized
RANSAC*, DAGM 2003; Umeyama, PAMI 1991). Points are then triangulated anew from all photos and bundle-adjusted. The joint model stands only
where enough points seen from both parts survive the filter of reprojection errors: two parts that move against each other, such as an
object and the room behind it, have none.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import closing
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.capture.colmap import pycolmap, repeatable_mapping

Doubles = NDArray[np.float64]

#: Common points that two models need, before they are aligned and after bundle adjustment.
MIN_COMMON_POINTS = 15
#: Largest distance of aligned common points, as a share of the spread (median distance from the median) of those of the larger model.
MAX_POINT_DISTANCE = 0.05
#: Filter of points: largest reprojection error in pixels and least triangulation angle in degrees (COLMAP's defaults).
MAX_REPROJECTION, MIN_ANGLE = 4.0, 1.5
#: By how many pixels the mean reprojection error may be larger than that of the worse model.
MAX_ERROR_INCREASE = 0.5


def merge_all(model: Any, others: Sequence[Any], database: Path, photos: Path, work: Path, seed: int) -> Any:
    """`model` with the photos of all `others` that can be tied to it, those with most new photos first; `model` itself where none can.

    `database` and `photos` are those of the reconstructions, `work` a folder for files that are removed.
    """
    left = list(others)
    while left:
        left = [other for other in left if new_photos(model, other)]
        left.sort(key=lambda other: -len(new_photos(model, other)))
        for k, other in enumerate(left):
            if (joint := merge(model, other, database, photos, work, seed)) is not None:
                model, left = joint, left[:k] + left[k + 1 :]
                break
        else:
            break
    return model


def merge(model: Any, other: Any, database: Path, photos: Path, work: Path, seed: int) -> Any | None:
    """A model of the photos of both, in the frame of `model`; None where too few points tie the two together."""
    with closing(pycolmap.Database.open(str(database))) as base:
        source, target = common_points(other, model, base)
    transform = _similarity(source, target, seed)
    if transform is None:
        return None
    moved = pycolmap.Reconstruction(other)
    moved.transform(transform)
    joint = _with_poses_of(model, moved)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    joint = pycolmap.triangulate_points(joint, str(database), str(photos), str(work), True, repeatable_mapping(seed))
    shutil.rmtree(work)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.solver_options.num_threads = 1  # with more, sums depend on the order in which threads finish
    pycolmap.bundle_adjustment(joint, adjustment)
    pycolmap.ObservationManager(joint).filter_all_points3D(MAX_REPROJECTION, MIN_ANGLE)
    bound = MAX_ERROR_INCREASE + max(m.compute_mean_reprojection_error() for m in (model, other))
    joint.update_point_3d_errors()
    tied = _points_of_both(joint, set(model.reg_image_ids()), set(new_photos(model, other)))
    return joint if tied >= MIN_COMMON_POINTS and joint.compute_mean_reprojection_error() <= bound else None


def common_points(first: Any, second: Any, base: Any) -> tuple[Doubles, Doubles]:
    """Points (n, 3) of the model `first` and the same points (n, 3) in `second`: each pair of points once, in a fixed order."""
    ours, theirs = (_points_of_features(model) for model in (first, second))
    found = [np.zeros((0, 2), np.int64)]
    for one, two in product(ours, theirs):
        matches = _same_features(one, two, len(ours[one]), base)
        both = np.column_stack([ours[one][matches[:, 0]], theirs[two][matches[:, 1]]])
        found.append(both[(both >= 0).all(1)])
    pairs = np.unique(np.concatenate(found), axis=0).tolist()
    positions = np.asarray([(first.points3D[a].xyz, second.points3D[b].xyz) for a, b in pairs], np.float64).reshape(-1, 2, 3)
    return positions[:, 0], positions[:, 1]


def _points_of_features(model: Any) -> dict[int, NDArray[np.int64]]:
    """For each registered photo the number of the point that every feature shows, -1 for none."""
    return {
        number: np.array([p.point3D_id if p.has_point3D() else -1 for p in model.image(number).points2D], np.int64)
        for number in sorted(model.reg_image_ids())
    }


def _same_features(one: int, two: int, count: int, base: Any) -> NDArray[np.int64]:
    """Indices (m, 2) of features of two photos that show the same point: all `count` of one photo, or those of a verified pair."""
    if one == two:
        return np.stack([np.arange(count)] * 2, 1)
    low, high = min(one, two), max(one, two)
    if not base.exists_two_view_geometry(low, high):
        return np.zeros((0, 2), np.int64)
    matches = np.asarray(base.read_two_view_geometry(low, high).inlier_matches, np.int64).reshape(-1, 2)
    return matches if one == low else matches[:, ::-1]


def _similarity(source: Doubles, target: Doubles, seed: int) -> Any | None:
    """The similarity that moves most points of `source` (n, 3) to `target` (n, 3); None where too few agree."""
    if len(source) < MIN_COMMON_POINTS:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_POINT_DISTANCE * float(np.median(np.linalg.norm(target - np.median(target, 0), axis=1)))
    options.random_seed = seed
    found: Any = pycolmap.estimate_sim3d_robust(source, target, options)
    return found["tgt_from_src"] if found is not None and found["num_inliers"] >= MIN_COMMON_POINTS else None


def _with_poses_of(model: Any, moved: Any) -> Any:
    """A model without points of the photos that `model`, or else `moved`, registers."""
    joint, lenses = pycolmap.Reconstruction(), set()
    for source in (model, moved):
        for number in sorted(set(source.reg_image_ids()) - set(joint.reg_image_ids())):
            image = source.image(number)
            if image.camera_id not in lenses:
                joint.add_camera_with_trivial_rig(source.cameras[image.camera_id])
                lenses.add(image.camera_id)
            posed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            joint.add_image_with_trivial_frame(posed, image.cam_from_world())
    return joint


def new_photos(model: Any, other: Any) -> list[int]:
    """Identifiers of the photos that only `other` registers."""
    return sorted(set(other.reg_image_ids()) - set(model.reg_image_ids()))


def _points_of_both(joint: Any, first: set[int], second: set[int]) -> int:
    """How many points are seen from photos of both sets."""
    seen = ({e.image_id for e in point.track.elements} for point in joint.points3D.values())
    return sum(bool(images & first) and bool(images & second) for images in seen)
