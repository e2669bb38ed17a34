"""Every form of a GLB in model-viewer: it opens without an error, and its picture is our own renderer's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsbake.config.schema import Targets
from gsbake.gltf.scene import open_scene
from gsbake.imaging.metrics import psnr
from gsbake.targets.build import TargetOptions, build_targets
from tests.support.browser import chromium
from tests.support.model_viewer import rendered, viewed

#: Measured: 34.8 to 34.9 dB; model-viewer filters its environment and its textures otherwise.
LEAST = 30.0
FILES = ("web", "banner", "default:ktx2+meshopt", "web:webp+quantised")
#: What model-viewer itself says on every page.
ITS_OWN = ("RGBELoader has been deprecated",)


@pytest.fixture(scope="module")
def built(folders: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    chromium()
    out = tmp_path_factory.mktemp("targets")
    build_targets(folders, out, TargetOptions(Targets(files=FILES, levels=1, lod_file=True)))
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["web", "web_lod1", "web_lods", "banner", "ktx2_meshopt", "web_webp_quantised"],
)
def test_model_viewer_shows_what_our_renderer_shows(built: Path, tmp_path: Path, name: str) -> None:
    path = built / f"asset_{name}.glb"
    scene = open_scene(path)
    image, found = viewed(path, scene, tmp_path)
    assert [e for e in found["errors"] if not any(known in e for known in ITS_OWN)] == []
    assert all("127.0.0.1" in address for address in found["requests"])
    ours, alpha = rendered(scene)
    theirs, cover = image[..., :3], image[..., 3]
    both = (cover > 0.99) & (alpha > 0.99)
    either = (cover > 0.5) | (alpha > 0.5)
    assert both.sum() / either.sum() > 0.95
    assert psnr(theirs, ours, both) > LEAST
    assert np.abs(theirs[both].mean(0) - ours[both].mean(0)).max() < 0.04
