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
    ["asset_web.glb", "asset_web_lod1.glb", "asset_web_lods.glb", "asset_banner.glb", "asset_ktx2_meshopt.glb", "asset_web_webp_quantised.glb"],
)
def test_model_viewer_shows_what_our_renderer_shows(built: Path, tmp_path: Path, name: str) -> None:
    scene = open_scene(built / name)
    image, found = viewed(built / name, scene, tmp_path)
    assert [e for e in found["errors"] if not any(known in e for known in ITS_OWN)] == []
    assert all("127.0.0.1" in address for address in found["requests"])
    ours, alpha = rendered(scene)
    theirs, cover = image[..., :3], image[..., 3]
    both = (cover > 0.99) & (alpha > 0.99)
    either = (cover > 0.5) | (alpha > 0.5)
    assert both.sum() / either.sum() > 0.95
    assert psnr(theirs, ours, both) > LEAST
    assert np.abs(theirs[both].mean(0) - ours[both].mean(0)).max() < 0.04
