"""The light as images and files: conventions, round trips, the sRGB transfer."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from gsbake.errors import BadInputError
from gsbake.geometry.vectors import unit
from gsbake.imaging import srgb_torch
from gsbake.shading import cubemap, neutral_light, panorama
from gsbake.shading.environment import EnvironmentLight


def sun_light(sun: np.ndarray, size: int = 64) -> EnvironmentLight:
    return EnvironmentLight.from_function(lambda d: 0.2 + 50.0 * (d @ sun > math.cos(math.radians(2.5)))[:, None] * np.ones(3), size)


@pytest.mark.parametrize(
    ("convention", "row", "column", "direction"),
    [
        # As a Cycles camera sees an image with one colour per column (Blender 4.5).
        ("blender", 0.5, 0.5, (1, 0, 0)),
        ("blender", 0.5, 0.25, (0, 1, 0)),
        ("blender", 0.5, 0.75, (0, -1, 0)),
        ("blender", 0.5, 0.0, (-1, 0, 0)),
        ("blender", 0.0, 0.5, (0, 0, 1)),
        ("gltf", 0.5, 0.5, (1, 0, 0)),
        ("gltf", 0.5, 0.25, (0, 0, -1)),
        ("gltf", 0.5, 0.75, (0, 0, 1)),
        ("gltf", 0.0, 0.5, (0, 1, 0)),
    ],
)
def test_conventions(convention: panorama.Convention, row: float, column: float, direction: tuple) -> None:
    dirs = panorama.directions(200, convention)
    pixel = dirs[min(int(row * 200), 199), min(int(column * 400), 399)]
    assert pixel @ np.array(direction) > 0.999


def test_pixels_match_the_viewers_formulas() -> None:
    blender = panorama.directions(16, "blender")
    x, y, z = np.moveaxis(blender, -1, 0)
    u, v = (0.5 - np.arctan2(y, x) / (2 * math.pi)) % 1, np.arctan2(z, np.hypot(x, y)) / math.pi + 0.5
    np.testing.assert_allclose(u, np.broadcast_to((np.arange(32) + 0.5) / 32, u.shape), atol=1e-12)
    np.testing.assert_allclose(v, np.broadcast_to(1 - (np.arange(16)[:, None] + 0.5) / 16, v.shape), atol=1e-12)
    x, y, z = np.moveaxis(panorama.directions(16, "gltf"), -1, 0)
    np.testing.assert_allclose(np.arctan2(z, x) / (2 * math.pi) + 0.5, u, atol=1e-12)
    np.testing.assert_allclose(np.arcsin(y) / math.pi + 0.5, v, atol=1e-12)
    # Turning Z-up into Y-up, (x, y, z) → (x, z, −y), leaves the image as it is.
    turned = blender @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(panorama.directions(16, "gltf"), turned, atol=1e-12)


@pytest.mark.parametrize("convention", ["blender", "gltf"])
def test_sun_comes_back_in_the_image(convention: panorama.Convention) -> None:
    sun = unit(np.array([0.48, -0.7, 0.53]))
    angle = 0.7
    rotation = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
    image = sun_light(sun).equirectangular(180, rotation, convention)
    assert image.shape == (180, 360, 3) and image.dtype == np.float32
    bright = image[..., 0] > 0.8 * image[..., 0].max()
    found = unit(panorama.directions(180, convention)[bright].mean(axis=0))
    assert math.degrees(math.acos(min(1.0, float(found @ (rotation @ sun))))) < 1.0
    back = EnvironmentLight.from_equirectangular(image, 64, rotation, convention).radiance().detach().numpy()
    weight = (back[..., 0] > 0.8 * back[..., 0].max())[..., None]
    again = unit((cubemap.directions(64) * weight).sum(axis=(0, 1, 2)))
    assert math.degrees(math.acos(min(1.0, float(again @ sun)))) < 1.0


def test_flux_survives_the_image() -> None:
    sun = unit(np.array([-0.3, 0.2, 0.93]))
    light = sun_light(sun, 32)
    flux = (light.radiance().detach().numpy() * cubemap.solid_angles(32)[..., None]).sum(axis=(0, 1, 2))
    for height in (16, 64):
        image = light.equirectangular(height)
        rows = np.pi * (0.5 - np.arange(height + 1) / height)
        angle = (np.sin(rows[:-1]) - np.sin(rows[1:])) * math.pi / height
        np.testing.assert_allclose((image * angle[:, None, None]).sum(axis=(0, 1)), flux, rtol=0.03)


def test_save_and_load(tmp_path: Path) -> None:
    radiance = np.random.default_rng(0).exponential(size=(6, 8, 8, 3)).astype(np.float32)
    radiance[0, 0, 0], radiance[1, 1, 1] = 1e4, 1e-5
    light = EnvironmentLight.from_radiance(radiance)
    np.testing.assert_allclose(light.radiance().detach().numpy(), radiance, rtol=1e-4)
    light.save(tmp_path / "light.safetensors")
    back = EnvironmentLight.load(tmp_path / "light.safetensors")
    assert back.size == 8
    torch.testing.assert_close(back.radiance(), light.radiance(), rtol=1e-4, atol=0)
    assert EnvironmentLight(4, 0.8).radiance().mean().item() == pytest.approx(0.8, rel=1e-5)


def test_bad_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "light.safetensors").write_bytes(b"nonsense")
    with pytest.raises(BadInputError, match="light.safetensors"):
        EnvironmentLight.load(tmp_path / "light.safetensors")
    with pytest.raises(BadInputError, match="shape"):
        EnvironmentLight.from_radiance(np.ones((6, 4, 5, 3)))
    with pytest.raises(BadInputError, match="negative"):
        EnvironmentLight.from_radiance(-np.ones((6, 4, 4, 3)))


def test_srgb() -> None:
    linear = torch.tensor([0.0, 0.001, 0.0031308, 0.18, 0.214041, 0.5, 1.0], dtype=torch.float64)
    coded = srgb_torch.linear_to_srgb(linear)
    expected = [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in linear.tolist()]
    np.testing.assert_allclose(coded.numpy(), expected, atol=1e-12)
    assert coded[4].item() == pytest.approx(0.5, abs=1e-5)
    inside = torch.tensor([0.0005, 0.002, 0.004, 0.3, 0.99], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(srgb_torch.linear_to_srgb, (inside,))
    wide = torch.tensor([-0.5, 0.0, 1.0, 7.0], dtype=torch.float64, requires_grad=True)
    out = srgb_torch.linear_to_srgb(wide)
    assert out.tolist() == pytest.approx([0.0, 0.0, 1.0, 1.0])
    out.sum().backward()
    assert wide.grad is not None and wide.grad.tolist() == pytest.approx([12.92, 12.92, 1.055 / 2.4, 1.055 / 2.4])


def test_colourfulness() -> None:
    assert neutral_light.neutral_light_loss(torch.full((6, 4, 4, 3), 0.7)).item() == pytest.approx(0.0, abs=1e-7)
    assert neutral_light.neutral_light_loss(torch.tensor([[1.0, 2.0, 3.0]])).item() == pytest.approx(2 / 3)
