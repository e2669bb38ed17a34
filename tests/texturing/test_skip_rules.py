"""Skip rules of the bake: exposure gains, normal map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from gsbake.capture.exposure import MAX_SPREAD
from gsbake.geometry.raycast import RayCaster
from gsbake.monitor import SILENT, SilentMonitor
from gsbake.texturing.exposure_agreement import Agreement
from gsbake.texturing.normal_map import sample_dense_mesh, vertex_normals
from gsbake.texturing.skip_rules import (
    MIN_COMMON_SHARE,
    MIN_COMMON_SHARE_WRITTEN,
    MIN_PAIRS,
    MIN_PHOTOS,
    believed_exposures,
    constant_exposure,
    normals_agree,
)


class Decisions(SilentMonitor):
    """Keeps what is decided."""

    def __init__(self) -> None:
        self.said: dict[str, tuple[str, str]] = {}

    def decide(self, what: str, choice: str, evidence: str, saved: float | None = None) -> None:
        """Keep it."""
        self.said[what] = choice, evidence


ENOUGH = {"error": 0.05, "pairs": MIN_PAIRS}


@pytest.mark.parametrize(("share", "constant"), [(-0.2, True), (MIN_COMMON_SHARE - 0.01, True), (MIN_COMMON_SHARE + 0.01, False)])
def test_exposures_differ_where_gains_are_common(share: float, constant: bool) -> None:
    holds, evidence = constant_exposure(Agreement(share, **ENOUGH), MIN_PHOTOS)
    assert holds is constant and f"{100 * max(share, 0):.0f} ± 5 %" in evidence


def test_few_photos_and_few_parts_say_nothing() -> None:
    common = Agreement(0.9, **ENOUGH)
    assert not constant_exposure(common, MIN_PHOTOS)[0] and constant_exposure(common, MIN_PHOTOS - 1)[0]
    assert constant_exposure(replace(common, pairs=MIN_PAIRS - 1), MIN_PHOTOS)[0]
    assert constant_exposure(None, MIN_PHOTOS)[0]
    enough, few = (constant_exposure(common, count)[1] for count in (MIN_PHOTOS, MIN_PHOTOS - 1))
    assert enough.endswith(f"threshold {100 * MIN_COMMON_SHARE:.0f} %") and "too few to tell" in few and "threshold" not in few


@pytest.mark.parametrize(("spread", "constant"), [(MAX_SPREAD - 0.02, True), (MAX_SPREAD + 0.02, False), (None, False)])
def test_photos_that_agree_at_tie_points_have_one_exposure(spread: float | None, constant: bool) -> None:
    assert constant_exposure(Agreement(0.5, **ENOUGH), MIN_PHOTOS, spread)[0] is constant
    assert constant_exposure(Agreement(0.0, **ENOUGH), MIN_PHOTOS, spread)[0]


def test_what_is_written_takes_more_to_contradict() -> None:
    middle, all_common = (Agreement(share, **ENOUGH) for share in (MIN_COMMON_SHARE + 0.1, MIN_COMMON_SHARE_WRITTEN + 0.01))
    holds, evidence = constant_exposure(middle, MIN_PHOTOS, written="EXIF gives all photos one exposure")
    assert holds and evidence.startswith(f"EXIF gives all photos one exposure; {100 * middle.share:.0f} ±")
    assert not constant_exposure(all_common, MIN_PHOTOS, 1.0, "EXIF gives all photos one exposure")[0]


def surface_samples(exposures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a surface in photos of these `exposures` (photos,), with noise."""
    rng = np.random.default_rng(3)
    logs = rng.normal(-1, 0.3, (500, 1)) + np.log(exposures) + rng.normal(0, 0.1, (500, len(exposures)))
    return logs[..., None] * np.ones(3), np.tile(np.arange(len(exposures)), (500, 1))


def test_written_exposures_are_believed_where_photos_show_them() -> None:
    exposures = np.array([0.5, 1.0, 1.0, 2.0, 1.0])
    known, said = believed_exposures(np.log(exposures), *surface_samples(exposures), SILENT)
    assert known is not None and np.exp(known) == pytest.approx(exposures) and said.startswith("EXIF gives exposures within 4.0x")


def test_written_exposures_of_edited_photos_are_not_believed() -> None:
    monitor, written = Decisions(), np.log([0.5, 1.0, 1.0, 2.0, 1.0])
    assert believed_exposures(written, *surface_samples(np.ones(5)), monitor) == (None, "")
    assert monitor.said["exposures by EXIF"][0] == "not used" and "within 4.0x" in monitor.said["exposures by EXIF"][1]


def test_one_written_exposure_is_no_gain() -> None:
    known, said = believed_exposures(np.log([1.0, 1.01, 1.0]), *surface_samples(np.ones(3)), SILENT)
    assert known is None and said == "EXIF gives all photos one exposure"
    assert believed_exposures(None, *surface_samples(np.ones(3)), SILENT) == (None, "")


def agreement(subdivisions: int, ripple: float) -> tuple[bool, str]:
    """`normals_agree` for a sphere of `subdivisions` against a fine one with ripples of height `ripple`."""
    coarse, fine = trimesh.creation.icosphere(subdivisions=subdivisions), trimesh.creation.icosphere(subdivisions=5)
    raised = fine.vertices * (1 + ripple * np.sin(12 * fine.vertices[:, :1]))
    dense = RayCaster(raised, fine.faces, 1)
    points, faces = trimesh.sample.sample_surface(coarse, 4000, seed=0)
    share = trimesh.triangles.points_to_barycentric(coarse.triangles[faces], points)
    normal = (vertex_normals(coarse.vertices, coarse.faces)[coarse.faces[faces]] * share[:, :, None]).sum(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normals_agree(sample_dense_mesh(points, normal, dense, vertex_normals(raised, fine.faces), 2 * np.sqrt(3)), normal)


def test_a_mesh_with_the_dense_normals_needs_no_map() -> None:
    holds, evidence = agreement(4, 0.0)
    assert holds and "95 %" in evidence


@pytest.mark.parametrize(("subdivisions", "ripple"), [(4, 0.01), (2, 0.006)])
def test_ripples_need_a_map(subdivisions: int, ripple: float) -> None:
    assert not agreement(subdivisions, ripple)[0]


def test_distant_dense_mesh_gives_no_map() -> None:
    away = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    dense = RayCaster(away.vertices + [5.0, 0, 0], away.faces, 1)
    normal = np.tile([0.0, 0, 1], (4, 1))
    detail = sample_dense_mesh(np.zeros((4, 3)), normal, dense, vertex_normals(dense.vertices, dense.faces), 2.0)
    holds, evidence = normals_agree(detail, normal)
    assert holds and "no dense surface" in evidence
