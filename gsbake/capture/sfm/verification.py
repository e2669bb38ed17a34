"""Verification of matches by two-view geometry (Hartley & Zisserman, *Multiple View Geometry*), for the pairs that need it.

COLMAP's own verification of a database repeats all of its pairs, whenever some are added. Here each pair is verified once, and its geometry
is kept beyond the run (`feature_cache`): it depends on the features of both photos, their lenses and the seed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from gsbake.capture.colmap import pycolmap
from gsbake.capture.sfm.feature_cache import FeatureCache
from gsbake.capture.sfm.pairs import Pair

#: Matrices of a two-view geometry, each of which may be absent.
_MATRICES = ("E", "F", "H")


def verify(database: Path, pairs: Sequence[Pair], reduced: Set[Pair], keys: Mapping[int, str], cache: FeatureCache, seed: int) -> int:
    """Write the two-view geometry of `pairs` of photo identifiers that have matches and no geometry yet; returns how many were computed.

    `keys` are those of the photos' features; of `reduced` pairs matches were left out. Runs with all processor cores; results do not depend
    on their number.
    """
    with closing(pycolmap.Database.open(str(database))) as base:
        images = {image.image_id: image for image in base.read_all_images()}
        lenses = {number: _lens(base.read_camera(image.camera_id)) for number, image in images.items()}
        pending: dict[tuple[int, int], tuple[str, str, str]] = {}
        for given in pairs:
            pair = min(given), max(given)  # the other way round COLMAP inverts what it writes and reads
            if base.exists_two_view_geometry(*pair) or not base.exists_matches(*pair):
                continue
            i, j = pair
            name = keys[i], keys[j], _digest([lenses[i], lenses[j], seed, pycolmap.__version__, given in reduced])
            if (kept := cache.geometry(name)) is None:
                pending[pair] = name
            else:
                base.write_two_view_geometry(*pair, _geometry(kept))
    if not pending:
        return 0
    listing = database.with_name("pairs.txt")
    listing.write_bytes("".join(f"{images[i].name} {images[j].name}\n" for i, j in pending).encode())
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    pycolmap.verify_matches(str(database), str(listing), options)
    with closing(pycolmap.Database.open(str(database))) as base:
        for pair, name in pending.items():
            if base.exists_two_view_geometry(*pair):
                cache.keep_geometry(name, _arrays(base.read_two_view_geometry(*pair)))
    return len(pending)


def _lens(camera: Any) -> list[Any]:
    """What of a camera the verification depends on, as JSON values."""
    return [camera.model_name, camera.width, camera.height, [float(x) for x in camera.params], bool(camera.has_prior_focal_length)]


def _digest(values: list[Any]) -> str:
    return blake3(json.dumps(values).encode()).hexdigest(16)


def _arrays(geometry: Any) -> dict[str, NDArray[Any]]:
    """A two-view geometry as arrays; what is absent has none."""
    found = {"config": np.array(int(geometry.config)), "matches": np.asarray(geometry.inlier_matches, np.uint32).reshape(-1, 2)}
    found["angle"] = np.array(float(geometry.tri_angle))
    found |= {name: np.asarray(matrix, float) for name in _MATRICES if (matrix := getattr(geometry, name)) is not None}
    if geometry.cam2_from_cam1 is not None:
        pose = geometry.cam2_from_cam1
        found["pose"] = np.concatenate([np.asarray(pose.rotation.quat, float), np.asarray(pose.translation, float)])
    return found


def _geometry(found: Mapping[str, NDArray[Any]]) -> Any:
    """The two-view geometry of `_arrays`."""
    geometry = pycolmap.TwoViewGeometry()
    geometry.config, geometry.inlier_matches, geometry.tri_angle = int(found["config"]), found["matches"], float(found["angle"])
    for name in _MATRICES:
        if name in found:
            setattr(geometry, name, found[name])
    if "pose" in found:
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(found["pose"][:4]), found["pose"][4:])
    return geometry
