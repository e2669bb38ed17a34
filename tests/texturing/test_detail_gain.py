"""The energy that averaging takes from fine detail: measured on patches, given back where views agree, and only there."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from gsbake.texturing import detail_gain as module
from gsbake.texturing.detail_gain import SIGMAS, DetailEnergy, detail_factor
from gsbake.texturing.texels import Texels

SIZE, VIEWS = 256, 5
#: A texture of one chart.
ONE = np.ones((SIZE, SIZE), np.uint8)


def texels() -> Texels:
    """A texture that is covered whole."""
    count = SIZE * SIZE
    return Texels(SIZE, np.arange(count), np.zeros(count, np.int32), np.zeros((count, 3), np.float32), np.ones(count, np.bool_))


class Views:
    """Samples of views (v, n, n) of luminance, as a blender holds them."""

    def __init__(self, planes: np.ndarray) -> None:
        self.planes = planes.reshape(len(planes), -1)

    def samples(self, rows: np.ndarray, gains: np.ndarray) -> tuple[Any, ...]:
        linear = np.repeat(np.maximum(self.planes[:, rows].T[..., None], 0) ** 2, 3, 2)
        views = np.tile(np.arange(len(self.planes), dtype=np.int16), (len(rows), 1))
        return linear / gains[views], np.ones(views.shape, np.float32), views


def energy_of(planes: np.ndarray) -> DetailEnergy:
    blender: Any = Views(planes)
    energy = DetailEnergy()
    energy.add(blender, texels(), (0, SIZE), 100, np.ones((len(planes), 3), np.float32))
    return energy


@pytest.fixture(scope="module")
def pattern() -> np.ndarray:
    """A texture with detail of about three texels."""
    noise = np.random.default_rng(0).normal(size=(SIZE, SIZE)).astype(np.float32)
    return np.asarray(0.5 + 0.25 * cv2.GaussianBlur(noise, (0, 0), 1.0), np.float32)


def shifted(pattern: np.ndarray, pixels: float) -> np.ndarray:
    """Views of the texture, each beside its place by up to so many texels."""
    moves = np.random.default_rng(1).uniform(-pixels, pixels, (VIEWS, 2))
    return np.stack(
        [cv2.warpAffine(pattern, np.float32([[1, 0, x], [0, 1, y]]), (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT) for x, y in moves]
    )


def test_views_in_place_keep_their_detail(pattern: np.ndarray) -> None:
    assert energy_of(np.stack([pattern] * VIEWS)).gains == pytest.approx((1,) * len(SIGMAS), abs=1e-4)


def test_noise_is_not_amplified() -> None:
    noise = 0.5 + 0.05 * np.random.default_rng(2).normal(size=(VIEWS, SIZE, SIZE))
    energy = energy_of(noise)
    assert energy.gains == (1.0,) * len(SIGMAS)
    assert np.abs(energy.common / energy.views).max() < 0.05


def test_detail_of_views_beside_each_other_comes_nearer_to_theirs(pattern: np.ndarray) -> None:
    views = shifted(pattern, 0.9)
    mean = views.mean(0)
    energy = energy_of(views)
    assert all(1.02 < gain < module.MAX_GAIN for gain in energy.gains[:2])
    colour = np.repeat((mean**2)[..., None], 3, 2).astype(np.float16)
    found = mean * np.sqrt(detail_factor(colour, np.ones((SIZE, SIZE), np.bool_), energy.gains, ONE))

    def detail(plane: np.ndarray) -> float:
        return float((cv2.Laplacian(plane, cv2.CV_32F) ** 2).mean())

    assert detail(mean) < 0.8 * detail(pattern)
    assert 1.1 * detail(mean) < detail(found) < detail(pattern)
    assert np.corrcoef(found.ravel(), pattern.ravel())[0, 1] > np.corrcoef(mean.ravel(), pattern.ravel())[0, 1] - 0.003


def test_few_patches_are_no_evidence(pattern: np.ndarray) -> None:
    energy = energy_of(shifted(pattern, 0.9)[:2])
    assert energy.patches == 0 and energy.gains == (1.0,) * len(SIGMAS) and "0 patches" in energy.evidence


def test_only_detail_of_what_is_observed_is_amplified(pattern: np.ndarray) -> None:
    colour = np.stack([pattern, 0.5 * pattern, 0.25 * pattern], 2).astype(np.float16)
    colour[:, :64] = 0.3
    observed = np.ones((SIZE, SIZE), np.bool_)
    observed[:, 200:] = False
    found = detail_factor(colour, observed, (1.4, 1.2, 1.1), ONE)
    assert (found[:, 200:] == 1).all()
    assert np.abs(found[:, :40] - 1).max() < 1e-3
    assert found[:, 70:190].std() > 0.02
    assert (detail_factor(colour, observed, (1.0, 1.0, 1.0), ONE) == 1).all()


def test_detail_does_not_leak_from_other_charts(pattern: np.ndarray) -> None:
    """A dark and a bright chart four texels beside each other, without any detail: neither has a line along the other. Detail of a band is
    amplified as far as its Gaussians reach no other chart."""
    charts = np.zeros((SIZE, SIZE), np.uint8)
    charts[:, :126], charts[:, 130:] = module.chart_codes(np.array([0, 300]))
    colour = np.where(charts[..., None] == 1, np.float16(0.05), np.float16(0.8)).repeat(3, 2)
    kept, leaking = (detail_factor(colour, charts > 0, (1.4, 1.4, 1.4), codes) for codes in (charts, ONE))
    assert np.abs(kept - 1).max() < 0.02 and np.abs(leaking - 1).max() > 0.3
    rough = np.repeat((pattern**2)[..., None], 3, 2).astype(np.float16)
    found, alone = (detail_factor(rough, charts > 0, (1.4, 1.0, 1.0), codes) for codes in (charts, ONE))
    np.testing.assert_array_equal(found[:, :125], alone[:, :125])
    assert found[:, :125].std() > 0.02


def test_near_another_chart() -> None:
    """Within two texels, beside empty ones too; charts 0 and 255 have one code."""
    charts = np.zeros((1, 12), np.uint8)
    charts[0, 0:4], charts[0, 5:9], charts[0, 10:] = module.chart_codes(np.array([0, 7, 255]))
    found = "".join(".#"[int(x)] for x in module.near_other_charts(charts, 2)[0])
    assert found == "...#.#..#.#."
    assert module.chart_codes(np.array([0, 254, 255])).tolist() == [1, 255, 1]
