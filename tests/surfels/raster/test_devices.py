"""Training's parts keep to the device of their tensors: run on "meta" tensors, where an operation across devices is an error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from gsbake.imaging.srgb_torch import linear_to_srgb
from gsbake.pipeline.machine import missing_cuda_requirement
from gsbake.shading.light_tables import LightTables
from gsbake.shading.neutral_light import neutral_light_loss
from gsbake.shading.prefilter import prefilter_operator
from gsbake.shading.split_sum import shade
from gsbake.surfels import spherical_harmonics as harmonics
from gsbake.surfels.densification.clone_split import Statistics
from gsbake.surfels.gbuffer import view_directions
from gsbake.surfels.losses import terms as losses
from gsbake.surfels.model import create
from gsbake.surfels.raster.cuda.projection import project
from gsbake.surfels.raster.projection import Pinhole
from gsbake.surfels.views import TrainView

PINHOLE = Pinhole(37, 29, 40.0, 44.0, 17.3, 15.2)


def meta(*shape: int) -> Tensor:
    return torch.rand(*shape, device="meta", requires_grad=True)


def view() -> TrainView:
    return TrainView("a", torch.zeros(3, 29, 37), torch.zeros(29, 37), torch.eye(3), torch.zeros(3), torch.zeros(3), PINHOLE)


def image(materials: bool) -> Tensor:
    planes, weights = meta(14 if materials else 12, 29, 37), losses.ImageWeights(0.2, 0.1, 0.1, 0.1, 0.1)
    # an index of pixels has no size on "meta": the picture of materials is the test "shade"
    return losses.image_losses(planes, planes[:3], view().to("meta"), True, meta(3), weights, materials)[0]


def tables_of(size: int) -> LightTables:
    """Prefiltered tables without data of a cube map with faces of `size`²."""
    layout = prefilter_operator(size).layout
    return LightTables(meta(layout.texels, 3), layout)


PARTS: dict[str, Callable[[], Tensor]] = {
    "colour": lambda: losses.colour_loss(meta(3, 29, 37), meta(3, 29, 37), 0.2),
    "normal": lambda: losses.normal_consistency(
        meta(3, 29, 37), meta(29, 37), losses.depth_normals(meta(29, 37), meta(3, 3), PINHOLE), meta(29, 37)
    ),
    "image": lambda: image(False),
    "image of materials": lambda: image(True),
    "harmonics": lambda: harmonics.colours(meta(9, 4, 3), meta(9, 3), meta(3)),
    "mask": lambda: losses.mask_entropy(meta(29, 37), meta(29, 37).detach()),
    "smoothness": lambda: losses.smoothness_loss(meta(5, 29, 37), meta(29, 37), meta(29, 37)),
    "white light": lambda: neutral_light_loss(meta(6, 8, 8, 3)),
    "sRGB": lambda: linear_to_srgb(meta(9, 3)),
    "shade": lambda: shade(
        meta(9, 3), meta(9, 3), meta(9, 3), meta(9), meta(9), tables_of(8)
    ),
    "projection": lambda: project(meta(9, 3), meta(9, 4), meta(9, 2), meta(9), meta(3, 3), meta(3), PINHOLE, True)[0],
    "view directions": lambda: view_directions(view().to("meta"), torch.zeros(4, dtype=torch.long, device="meta")) * meta(4, 3),
}


@pytest.mark.parametrize("part", PARTS.values(), ids=list(PARTS))
def test_forward_and_backward_stay_on_the_device(part: Callable[[], Tensor]) -> None:
    out = part()
    assert out.device.type == "meta" and out.requires_grad
    out.sum().backward()


def test_mixed_devices_are_an_error_on_meta() -> None:
    with pytest.raises(RuntimeError, match="device"):
        losses.mask_entropy(meta(29, 37), torch.zeros(29, 37))


def test_state_moves_as_a_whole() -> None:
    points = np.eye(3)
    surfels = create(points, points, np.ones(3), None, "pbr", 0, 0.0, 1.0, "neus").to("meta")
    assert {x.device.type for x in surfels.tensors().values()} == {"meta"} and surfels.transfer.name == "neus"
    assert surfels.opacity().device.type == surfels.features(torch.zeros(3, device="meta")).device.type == "meta"
    moved = view().to("meta")
    assert {x.device.type for x in (moved.colour(), moved.cover(), moved.R, moved.t, moved.centre) if x is not None} == {"meta"}
    stats = Statistics.zeros(3, "meta")
    stats.add(torch.zeros(3, 9, device="meta"), torch.zeros(3, device="meta"), 64)
    assert stats.mean_gradient().device.type == "meta"


@pytest.mark.skipif(missing_cuda_requirement() is not None, reason="no usable GPU")
@pytest.mark.slow
def test_on_the_gpu() -> None:
    """Parity of planes and gradients, and a short training, against the CPU; in a process where Triton compiles."""
    import subprocess
    import sys

    done = subprocess.run([sys.executable, "-m", "benchmarks.device", "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
